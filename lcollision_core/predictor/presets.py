"""The network of each preset."""

from __future__ import annotations

from lcollision_core.predictor.geometric.network import GeometricNetwork
from lcollision_core.predictor.network import PredictorNetwork
from lcollision_core.predictor.paper.network import PaperNetwork

NETWORKS: dict[str, type[PredictorNetwork]] = {"default": GeometricNetwork, "paper": PaperNetwork}
