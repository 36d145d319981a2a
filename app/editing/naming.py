"""What people call the codes and the body parts of a model, and the poses that come with it."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lcollision_core.bodies import NamedPose, PosableBody


def code_name(model: PosableBody, index: int) -> str:
    """Return the display name of one latent entry."""
    group = next(g for g in model.latent_space.groups if index < g.codes.stop)
    name = model.code_names[index]
    return name if group.colour is None else f"{group.name}, {name}"


def domain_of(model: PosableBody, vertex: int) -> int:
    """Return the body part that leads a vertex, from 0."""
    return int(model.space.vertex_domain[vertex])


def part_name(model: PosableBody, vertex: int) -> str:
    """Return the name of the body part that leads a vertex."""
    return model.domain_names[domain_of(model, vertex)]


def training_pose(model: PosableBody, number: int) -> NamedPose:
    """Return a training pose of the model by its number, from 0."""
    from lcollision_core.bodies import NamedPose

    return NamedPose(model.card.pose_names[number], model.known_poses[number])


def starter_poses(model: PosableBody) -> list[NamedPose]:
    """Return poses to begin with, none of a body whose joints are not known."""
    from lcollision_core.bodies import NamedPose

    return [NamedPose(pose.name, pose.codes, moves=pose.moves) for pose in model.starter_poses]
