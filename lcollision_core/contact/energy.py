"""Penetration energy of body parts."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import ShapeError


def domain_energy(
    vertex_energy: npt.NDArray[np.float64], attention_mask: npt.NDArray[np.floating]
) -> npt.NDArray[np.float64]:
    """Sum each vertex's penetration energy into the domains.

    Parameters
    ----------
    vertex_energy : (B, V) float64 array, PDe of Algorithm 1, in normalised length squared
    attention_mask : (K, V) array, each column sums to 1

    Returns
    -------
    domain_energy : (B, K) float64 array, >= 0, same unit; each row sums to PDe-sum

    Raises
    ------
    ShapeError : V differs.

    Notes
    -----
    The targets of L_PD of Tan et al. 2021, section "Collision Predictor Based on Penetration".
    """
    if vertex_energy.ndim != 2 or attention_mask.ndim != 2:
        shapes = f"{vertex_energy.shape} and {attention_mask.shape}"
        raise ShapeError.must_be("energies and masks", "(B, V) and (K, V)", shapes)
    if vertex_energy.shape[1] != attention_mask.shape[1]:
        raise ShapeError(
            f"energies are of {vertex_energy.shape[1]} vertices, masks of {attention_mask.shape[1]}"
        )
    return vertex_energy @ attention_mask.T.astype(np.float64)
