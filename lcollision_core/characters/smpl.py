"""The body models of the SMPL family as characters."""

from __future__ import annotations

from collections.abc import Container

import numpy as np

from lcollision_core.characters.character import Character, ClipFrames, Rig
from lcollision_core.errors import MeshFileError
from lcollision_core.meshes.formats.smpl import SmplModel
from lcollision_core.meshes.topology import FloatArray


def character_of_smpl(
    model: SmplModel, betas: FloatArray | None = None, moving: Container[str] | None = None
) -> Character:
    """Make a character of a body model, whose joints turn about any axis.

    Parameters
    ----------
    betas : (n,) the shape; the mean shape if None, as where the model has fewer numbers
    moving : names of the joints that turn; all if None
    """
    shape = np.zeros(0) if betas is None else betas[: model.shape_directions.shape[2]]
    vertices, joints = model.shaped(shape)
    rest = np.broadcast_to(np.eye(4), (len(joints), 4, 4)).copy()
    rest[:, :3, 3] = joints
    n_most = int((model.weights > 0.0).sum(axis=1).max())
    order = np.argsort(-model.weights, axis=1, kind="stable")[:, :n_most]
    rig = Rig(
        model.names,
        model.parents,
        rest,
        np.arange(len(joints)),
        order.astype(np.int32),
        np.take_along_axis(model.weights, order, axis=1),
        np.repeat(vertices[:, None], n_most, axis=1),
        moving=np.array([moving is None or name in moving for name in model.names]),
        pose_shapes=model.pose_directions,
    )

    def sample(clip: str, _: float | FloatArray | None) -> ClipFrames:
        raise MeshFileError(f"has no animation {clip!r}", "name a motion", where=model.path)

    return Character(
        model.path.stem,
        model.path,
        model.topology,
        vertices,
        np.arange(len(vertices)),
        np.array([0.0, 1.0, 0.0]),
        True,
        1.0,
        (),
        rig,
        {},
        sample,
        smpl=model,
    )
