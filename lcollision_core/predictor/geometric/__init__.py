"""The default network, in torch: what is trained, and what predicts on a GPU."""
