"""Stage 2: from labelled samples to a trained predictor."""
