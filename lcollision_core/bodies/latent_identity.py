"""Fingerprints of latent spaces, and the listed model that has a given one."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy.typing as npt

from lcollision_core.bodies.model_store import ListedModel, list_models
from lcollision_core.embedding.bilevel import BOX_ARRAYS
from lcollision_core.errors import ModelFileError
from lcollision_core.model_file import digest_of, read_section

EMBEDDING = "embedding"
"""The section of a model file with its latent space."""


def fingerprint_of(arrays: Mapping[str, npt.NDArray[Any]], metadata: Mapping[str, Any]) -> str:
    """Return 16 hexadecimal digits that identify a latent space, whatever its box.

    Parameters
    ----------
    arrays, metadata : of `Embedding.to_arrays`, or of a model file's section
    """
    weights = {name: arrays[name] for name in arrays.keys() - BOX_ARRAYS}
    return digest_of(json.dumps(metadata["scaling"], sort_keys=True), weights)[:16]


def find_latent_space(fingerprint: str, name: str = "") -> ListedModel | None:
    """Find a bundled or user model by its latent space, without loading whole models.

    Parameters
    ----------
    fingerprint : of the latent space
    name : of the model that it probably is, which is looked at first

    Returns
    -------
    model : None if no listed model has that latent space; files that cannot be read are passed
        over
    """
    for model in sorted(list_models(), key=lambda listed: listed.name != name):
        try:
            section = read_section(model.path, EMBEDDING)
        except ModelFileError:
            continue
        if section is None or "scaling" not in section.metadata:
            continue
        if fingerprint_of(section.arrays, section.metadata) == fingerprint:
            return model
    return None
