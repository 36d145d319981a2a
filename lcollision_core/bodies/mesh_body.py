"""A mesh without joints, or a sequence of its frames: a body that is checked but not posed."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
import numpy.typing as npt

from lcollision_core.bodies.body import Body
from lcollision_core.bodies.card import LEAST_BODY_SIZE, ModelCard
from lcollision_core.bodies.names import CodeEffect
from lcollision_core.contact import STRICT, CollisionDetector, ContactRules
from lcollision_core.embedding.bilevel import LatentFit
from lcollision_core.errors import LCollisionError
from lcollision_core.files import PoseSet
from lcollision_core.jobs import Job
from lcollision_core.meshes import FaceGroup, Topology
from lcollision_core.meshes.face_groups import component_labels
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.model_file import digest_of

if TYPE_CHECKING:
    from lcollision_core.posing import PoseSpace
    from lcollision_core.resolve import PoseResolver


class MeshBody(Body):
    """A mesh of a file, or the frames of a point cache or of a clip of meshes.

    It has contact rules and groups of faces like every body; anything that needs a pose space
    raises.

    Parameters
    ----------
    frames : (N, V, 3) float32 or float64 array, in the file's unit
    topology : of all frames
    reference : (V, 3) array, the rest pose or a substitute
    rules, groups : of the file
    vertex_labels : (V,) names of body parts, if known

    Attributes
    ----------
    frames : as given

    Raises
    ------
    ShapeError : the reference cannot be checked.
    """

    no_predictor = "the mesh has no predictor", "name a model"
    can_resolve = False

    def __init__(
        self,
        frames: npt.NDArray[np.floating],
        topology: Topology,
        reference: npt.NDArray[np.floating],
        rules: ContactRules = STRICT,
        groups: tuple[FaceGroup, ...] = (),
        vertex_labels: npt.NDArray[np.str_] | None = None,
    ) -> None:
        detector = CollisionDetector(topology, reference, rules, groups)
        card = ModelCard(
            # A check needs no unit, so the mesh may be larger or smaller than a model.
            height=float(np.clip(detector.body_size, LEAST_BODY_SIZE, 1.0 / LEAST_BODY_SIZE)),
            up_axis=1,
            domain_names=("mesh",),
            domain_colours=("#808080",),
            pose_names=(),
            source="unknown",
            licence="unknown",
            rules=rules,
            groups=groups,
        )
        mask = np.ones((1, topology.n_vertices), dtype=np.float32)
        rest = np.asarray(reference, dtype=np.float64)
        super().__init__("the mesh", card, topology, rest, mask, np.empty((0, 0)))
        self.frames, self._labels = frames, vertex_labels
        self.__dict__["detector"] = detector

    @classmethod
    def of_poses(
        cls, poses: PoseSet, reference: npt.NDArray[np.floating] | None = None
    ) -> MeshBody:
        """Return the frames of a file; its first pose is the rest pose.

        Parameters
        ----------
        reference : (V, 3) array, another rest pose
        """
        rest = poses.vertices[0] if reference is None else reference
        groups, labels = poses.groups, poses.vertex_labels
        return cls(poses.vertices[1:], poses.topology, rest, poses.rules, groups, labels)

    def vertices_at(self, frame: int, share: float) -> npt.NDArray[np.floating]:
        """Return the (V, 3) vertices a share of the way from a frame to the next."""
        after = self.frames[min(frame + 1, len(self.frames) - 1)]
        vertices: npt.NDArray[np.floating] = (1.0 - share) * self.frames[frame] + share * after
        return vertices

    @cached_property
    def parts(self) -> tuple[list[str], npt.NDArray[np.intp]]:
        """Names of the body parts, or of the connected components, and (V,) each vertex's index."""
        labels = component_labels(self.topology) if self._labels is None else self._labels
        names, owner = np.unique(labels, return_inverse=True)
        return names.tolist(), owner

    def _vertex_labels(self) -> npt.NDArray[np.str_] | None:
        return self._labels

    @property
    def _nameable_groups(self) -> list[FaceGroup]:
        return [group for kind in self.groups_by_kind.values() for group in kind]

    def _refuse(self) -> NoReturn:
        what = "has neither joints nor learned poses"
        raise LCollisionError(what, "name a rigged character or a model", where=self.name)

    @property
    def space(self) -> PoseSpace:
        """Raises: there are no codes."""
        self._refuse()

    @property
    def code_effects(self) -> tuple[CodeEffect, ...]:
        """Raises: there are no codes."""
        self._refuse()

    @property
    def resolver(self) -> PoseResolver:
        """Raises: nothing moves the mesh."""
        self._refuse()

    def _fit(self, vertices: FloatArray, job: Job, *, in_place: bool) -> LatentFit:  # noqa: ARG002
        self._refuse()

    @cached_property
    def fingerprint(self) -> str:
        """16 hexadecimal digits that identify the faces and the rest pose."""
        arrays: dict[str, npt.NDArray[Any]] = {"faces": self.topology.faces}
        return digest_of("mesh", arrays | {"reference": self.reference})[:16]

    @property
    def body_size(self) -> float:
        """The body size in the file's unit."""
        return self.detector.body_size

    @property
    def free_latent(self) -> FloatArray:
        """Empty: there are no codes."""
        return np.empty((0, 0))
