"""What stands round the viewport: sliders, prediction, exact check, Resolve, pose library."""
