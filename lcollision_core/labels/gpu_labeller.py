"""Label latent codes exactly on a GPU; only the labels leave it."""
# mypy: disable-error-code="no-untyped-def, untyped-decorator"

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lcollision_core.contact import CollisionDetector
from lcollision_core.contact.kernels import COUNTED
from lcollision_core.embedding.bilevel import Embedding
from lcollision_core.embedding.gpu_decoder import GpuDecoder
from lcollision_core.on_gpu import GPU_LOCK, THREADS, Buffers, blocks_for, cuda


@cuda.jit
def sum_energies(vertex_energy, shares, sums):
    """Write (B, K) sums of (B, V) energies weighted by (V, K) shares, each in vertex order."""
    first, n_domains = cuda.grid(1), shares.shape[1]
    for cell in range(first, sums.shape[0] * n_domains, cuda.gridsize(1)):
        row, domain = cell // n_domains, cell % n_domains
        total = 0.0
        for v in range(shares.shape[0]):
            total += shares[v, domain] * vertex_energy[row, v]
        sums[row, domain] = total


class GpuLabeller:
    """Label codes of one model on a GPU.

    Parameters
    ----------
    embedding, body_size : as for `Labeller`
    detector : the exact check
    shares : (K, V) share of each domain in the vertices
    """

    def __init__(
        self,
        embedding: Embedding,
        body_size: float,
        detector: CollisionDetector,
        shares: npt.NDArray[np.float64],
    ) -> None:
        self._decoder, self._detector = GpuDecoder(embedding, body_size), detector
        columns = np.concatenate([shares, np.ones((1, shares.shape[1]))]).T
        self._shares = cuda.to_device(np.ascontiguousarray(columns))
        self._buffers = Buffers()

    def label(
        self, codes: npt.NDArray[np.float32]
    ) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float64], list[int]]:
        """Label (B, D) codes.

        Returns
        -------
        n_pairs : (B,) number of colliding pairs
        energy : (B, K + 1), of the domains and in total, in normalised length squared
        left : indices of poses that are left to the CPU
        """
        n_pairs = np.zeros(len(codes), dtype=np.int32)
        energy = np.zeros((len(codes), self._shares.shape[1]))
        left: list[int] = []
        search, start = self._detector.gpu_search(), 0
        with GPU_LOCK:
            while start < len(codes):
                part = slice(start, start + min(self._decoder.at_once, search.at_once))
                collisions = search.search(
                    self._decoder.decode(codes[part]),
                    with_energy=True,
                    uncounted=self._detector.uncounted_nodes(),
                )
                sums = self._buffers.take("sums", energy[part].shape, np.float64)
                sum_energies[blocks_for(sums.size), THREADS](
                    collisions.vertex_energy, self._shares, sums
                )
                n_pairs[part] = collisions.n_by_rule.copy_to_host()[:, COUNTED]
                energy[part] = sums.copy_to_host()
                left += [start + number for number in collisions.left]
                start = part.stop
        return n_pairs, energy, left
