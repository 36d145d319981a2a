"""The network of each preset."""

from __future__ import annotations

from lcollision_core.predictor.geometric_network import GeometricNetwork
from lcollision_core.predictor.network_base import PredictorNetwork
from lcollision_core.predictor.paper_network import PaperNetwork

NETWORKS: dict[str, type[PredictorNetwork]] = {
    "default": GeometricNetwork,
    "large": GeometricNetwork,
    "paper": PaperNetwork,
}
