"""The network of each preset."""

from __future__ import annotations

from lcollision_core.predictor.geometric import GeometricNetwork
from lcollision_core.predictor.networks import PaperNetwork, PredictorNetwork

NETWORKS: dict[str, type[PredictorNetwork]] = {"default": GeometricNetwork, "paper": PaperNetwork}
