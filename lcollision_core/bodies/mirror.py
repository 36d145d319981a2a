"""Left and right: a mesh's plane of symmetry, and the mirror images of its poses."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lcollision_core.bodies.matching import sorted_faces
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes import RigidTransform, Topology

if TYPE_CHECKING:
    from lcollision_core.posing import ExactCheck, Pin
    from lcollision_core.resolve import ResolveOptions, ResolveResult

FloatArray = npt.NDArray[np.float64]

_TOLERANCE = 1e-3
"""Normalised: how far a vertex may lie from its partner's mirror image in a symmetric mesh."""

_NEAR, _MOST = 0.01, 0.7
"""Normalised, how far in another mesh; and the least share of its vertices that lie so near."""

_STEPS = 4
"""In which the plane of a mesh that is not symmetric is found."""


@dataclass(frozen=True, eq=False)
class Symmetry:
    """The plane between the sides of a mesh, and what lies where on the other side.

    Attributes
    ----------
    partner : (V,) int32 array, read-only, each vertex's mirror image: its own inverse where the
        mesh is symmetric, else the vertex nearest to the image
    normal : (3,) float64 unit vector, from one side to the other
    offset : of the plane along the normal, in the mesh's unit
    """

    partner: npt.NDArray[np.int32]
    normal: FloatArray
    offset: float

    @cached_property
    def flip(self) -> FloatArray:
        """(4, 4) the reflection in the plane."""
        flip = np.eye(4)
        flip[:3, :3] -= 2.0 * np.outer(self.normal, self.normal)
        flip[:3, 3] = 2.0 * self.offset * self.normal
        return flip

    def reflect(self, points: npt.ArrayLike) -> FloatArray:
        """Return the mirror images of (..., 3) points."""
        image: FloatArray = np.asarray(points) @ self.flip[:3, :3] + self.flip[:3, 3]
        return image

    def image(self, vertices: npt.NDArray[Any]) -> FloatArray:
        """Reflect (V, 3) vertices, and give each the number of its partner: (V, 3)."""
        return self.reflect(np.asarray(vertices, dtype=np.float64)[self.partner])

    def image_of_placement(self, placement: RigidTransform) -> RigidTransform:
        """Return the motion that takes a mesh's image to where the placed mesh's image is."""
        flip, shift = self.flip[:3, :3], self.flip[:3, 3]
        moved = self.reflect(placement.apply(shift))
        return RigidTransform(flip @ placement.rotation @ flip, moved, placement.scale)

    def image_of_pin(self, pin: Pin) -> Pin:
        """Return the pin of the partner's patch in the mirrored place."""

        def image(place: tuple[float, float, float]) -> tuple[float, float, float]:
            x, y, z = self.reflect(place).tolist()
            return x, y, z

        return replace(
            pin,
            vertex=int(self.partner[pin.vertex]),
            position=image(pin.position),
            frame=tuple((int(self.partner[at]), image(place)) for at, place in pin.frame),
        )


@dataclass(frozen=True, eq=False)
class MirrorSource:
    """The pose that another one is the mirror image of.

    Attributes
    ----------
    latent : (D,) float64 array
    placement : where the decoded pose belongs, None for the model's own coordinates
    image : the fingerprint of the mirror image; any other pose has another source
    """

    latent: FloatArray
    placement: RigidTransform | None
    image: str

    def is_of(self, latent: npt.NDArray[Any], placement: RigidTransform | None) -> bool:
        """Whether a pose is the mirror image, unchanged to the bit."""
        return self.image == fingerprint_of_pose(latent, placement)


@dataclass(frozen=True, eq=False)
class MirroredPose:
    """A pose with left and right exchanged. Lengths are normalised.

    Attributes
    ----------
    latent : (D,) float64 array
    placement : where the decoded pose belongs, None for the model's own coordinates
    fit_error_mean, fit_error_max : distance of the decoded vertices from the exact mirror image
    restored : it is the pose that the given one was mirrored from, to the bit
    pairs_before : colliding pairs of faces of the given pose, by the exact check
    pairs_mirrored : of the pose that is nearest to the mirror image
    pairs_after : of this pose
    resolution : the Resolve of the collisions that mirroring brought, None if there was none
    source : of this pose: the given one
    """

    latent: FloatArray
    placement: RigidTransform | None
    fit_error_mean: float
    fit_error_max: float
    restored: bool
    pairs_before: int
    pairs_mirrored: int
    pairs_after: int
    resolution: ResolveResult | None
    source: MirrorSource

    @property
    def lost_freedom(self) -> bool:
        """Whether a pose that was free collides now."""
        return self.pairs_before == 0 < self.pairs_after


def pose_bytes(latent: npt.NDArray[Any], placement: RigidTransform | None) -> bytes:
    """Return bytes that are equal for equal poses with equal placements, and for no others.

    Parameters
    ----------
    latent : (D,) array
    placement : None for the model's own coordinates
    """
    arrays: list[npt.ArrayLike] = [latent]
    if placement is not None:
        arrays += [placement.rotation, placement.translation]
        if placement.scale != 1.0:
            arrays.append(placement.scale)
    return b"".join(np.asarray(array, dtype="<f8").tobytes() for array in arrays)


def fingerprint_of_pose(latent: npt.NDArray[Any], placement: RigidTransform | None) -> str:
    """Return 16 hexadecimal digits that identify a pose and its placement, to the bit."""
    return hashlib.sha256(pose_bytes(latent, placement)).hexdigest()[:16]


@dataclass(frozen=True, eq=False)
class PoseMirror:
    """Exchanges left and right of one body's poses; immutable, safe between threads.

    Attributes
    ----------
    attention_mask : (K, V) float32 array
    symmetry : of the mesh, in the body's unit
    check : the exact check of the body's poses
    nearest : finds the codes of (V, 3) normalised vertices, in place
    resolve : `PosableBody.resolve`, for what collides in the mirror only; None leaves it colliding
    """

    attention_mask: npt.NDArray[np.float32]
    symmetry: Symmetry
    check: ExactCheck
    nearest: Callable[[FloatArray, Job], FloatArray]
    resolve: Callable[..., ResolveResult] | None

    def mirror(
        self,
        latent: npt.NDArray[Any],
        placement: RigidTransform | None = None,
        source: MirrorSource | None = None,
        options: ResolveOptions | None = None,
        job: Job = UNWATCHED,
    ) -> MirroredPose:
        """Find the pose nearest to the mirror image of one, with the mirrored placement.

        The plane is the reference's, for a placed pose too. Where the pose is free and what comes
        of it is not, it is resolved; a colliding pose is not resolved.

        Parameters
        ----------
        latent : (D,) finite array
        placement : where the decoded pose belongs, None for the model's own coordinates
        source : what the pose was mirrored from, or None: where it is still that image, what
            comes back is the source, to the bit
        options : of the Resolve; its locked domains keep their mirrored codes
        job : reports (steps of the Resolve done, all steps); polled between the steps

        Raises
        ------
        ShapeError, LCollisionError, CancelledError : as of `PosableBody.resolve`.
        """
        pose, size = np.array(latent, dtype=np.float64), self.check.body_size
        check = replace(self.check, placement=placement)
        decoded = check.decode(pose)[0]
        pairs_before = len(check.find(check.exported(decoded)).pairs)
        image = self.symmetry.image(decoded * size) / size
        image_placement = None if placement is None else self.symmetry.image_of_placement(placement)
        restored = source is not None and source.is_of(pose, placement)
        if source is not None and restored:
            found, image_placement = source.latent, source.placement
        else:
            # With the placement fixed: a fitted rigid motion would have to be undone, and the
            # codes hold it nearly as well.
            found = self._codes_of_image(pose, image, job)
        check = replace(check, placement=image_placement)
        mirrored = check.decode(found)[0]
        pairs_mirrored = pairs_after = len(check.find(check.exported(mirrored)).pairs)
        resolution = None
        if not restored and pairs_before == 0 < pairs_mirrored and self.resolve is not None:
            resolution = self.resolve(found, options, job, image_placement)
            if resolution.exactly_free:
                found, pairs_after = resolution.latent, 0
                mirrored = check.decode(found)[0]
        distances = self._misfit(pose, found, mirrored - image)
        return MirroredPose(
            latent=found,
            placement=image_placement,
            fit_error_mean=float(distances.mean()),
            fit_error_max=float(distances.max()),
            restored=restored,
            pairs_before=pairs_before,
            pairs_mirrored=pairs_mirrored,
            pairs_after=pairs_after,
            resolution=resolution,
            source=MirrorSource(pose, placement, fingerprint_of_pose(found, image_placement)),
        )

    def _misfit(
        self,
        latent: FloatArray,  # noqa: ARG002 - the vertices tell
        mirrored: FloatArray,  # noqa: ARG002
        off: FloatArray,
    ) -> FloatArray:
        """Return how far places of a mirrored pose are from the mirror image: (n,), normalised.

        Parameters
        ----------
        latent, mirrored : (D,) codes of a pose, and of its mirrored one
        off : (V, 3) from the mirror image's vertices to those of the mirrored pose
        """
        distances: FloatArray = np.linalg.norm(off[self.check.space.topology.picked], axis=1)
        return distances

    def _codes_of_image(
        self,
        latent: FloatArray,  # noqa: ARG002 - bodies whose codes have sides need no fit
        image: FloatArray,
        job: Job,
    ) -> FloatArray:
        """Return the (D,) codes of the mirror image of a pose, whose (V, 3) vertices it is."""
        return self.nearest(image, job)

    def partner(self, domain: int) -> int | None:
        """Return the domain on the other side; None for one in the middle, or unlike any other."""
        mask = self.attention_mask

        def image(of: int) -> int:
            return int((mask @ mask[of, self.symmetry.partner]).argmax())

        other = image(domain)
        return other if other != domain == image(other) else None

    def mirror_part(
        self,
        latent: npt.NDArray[Any],
        domain: int,
        job: Job = UNWATCHED,
    ) -> FloatArray:
        """Give the domain on the other side the codes that it has in the mirror image.

        All other codes stay. As neighbouring domains share their borders, the other side becomes
        like the mirror image, not equal to it.

        Parameters
        ----------
        latent : (D,) finite array
        domain : that has a `partner`

        Returns
        -------
        latent : (D,) float64 array
        """
        size = self.check.body_size
        image = self.symmetry.image(self.check.decode(latent)[0] * size) / size
        mirrored = self._codes_of_image(latent, image, job)
        other = self.partner(domain)
        own = self.check.space.codes_of([] if other is None else [other])
        return np.where(own, mirrored, latent)


def find_symmetry(reference: npt.NDArray[Any], topology: Topology, up_axis: int) -> Symmetry | None:
    """Find each vertex's partner on the other side of a mesh.

    Where the mesh is its own mirror image, faces are mapped onto faces. Else, as with a sword in
    one hand or armour on one shoulder, a vertex's partner is the one nearest to its image, and most
    vertices must have one near to it: the pose that comes nearest to so many partners is the
    mirrored one, whatever has none.

    Parameters
    ----------
    reference : (V, 3) array, a pose whose limbs lie symmetrically
    topology : of the mesh; vertices that no face names are their own partners
    up_axis : 0, 1 or 2; left and right are along one of the other two

    Returns
    -------
    symmetry : None if there is none
    """
    from scipy.spatial import cKDTree

    used, faces = topology.used_vertices, topology.faces
    vertices = np.asarray(reference, dtype=np.float64)[used]
    size = float(np.ptp(vertices, axis=0).max())
    tree = cKDTree(vertices)
    everyone = np.arange(len(vertices), dtype=np.int32)
    best: tuple[float, Symmetry] | None = None
    for axis in (axis for axis in range(3) if axis != up_axis):
        across = vertices[:, axis]
        for offset in (0.5 * (across.min() + across.max()), np.median(across)):
            for _ in range(_STEPS):
                plane = Symmetry(everyone, np.eye(3)[axis], float(offset))
                distance, nearest = tree.query(plane.reflect(vertices))
                partner = np.arange(topology.n_vertices, dtype=np.int32)
                partner[used] = used[nearest]
                partner.flags.writeable = False
                found = replace(plane, partner=partner)
                is_exchange = (
                    distance.max() < _TOLERANCE * size and (nearest[nearest] == everyone).all()
                )
                if is_exchange and np.array_equal(
                    sorted_faces(partner[faces[:, ::-1]]), sorted_faces(faces)
                ):
                    return found
                share = float((distance < _NEAR * size).mean())
                if share >= _MOST and (best is None or share > best[0]):
                    best = share, found
                # What is on one side alone has moved the middle.
                offset = np.median(0.5 * (across + across[nearest]))
    return None if best is None else best[1]
