"""The default network, in torch, for training and for prediction on a GPU."""
