"""The network of Tan et al. 2021 and its three losses."""
