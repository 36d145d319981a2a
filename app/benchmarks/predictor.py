"""The predictor against the exact check, on poses drawn from a model's latent box.

The exact check stops at a pose's first pair and distributes the poses over all cores, as the peer
in the paper's Table 3 does; it needs the mesh, so decoding counts as its cost. python-fcl cannot
stop at the first pair that counts (faces that share a vertex touch), so it finds all; it is timed
on few poses and one core, and its time is scaled as if it used all cores without loss.

The fields of a row, one for each device; times are of poses from latent codes:

device : "cpu" or "cuda"
preset : of the predictor
batch : poses predicted at a time
cores : that the CPU's times may use, except `gradient_ms`
us_per_pose : prediction in such batches, microseconds, median of the rounds
gradient_ms : logit and gradient of one pose, on one core or the GPU, median
exact_ms_per_pose : exact verdict of a decoded pose, on all cores
decode_ms_per_pose : decoding, on all cores
speedup : (decode + exact) over predicted
gemm_fraction : the network's floating-point rate over that of one large matrix product on the
    device
hybrid_ms_per_pose : the hybrid verdict with `ERROR_BOUND`, on all cores; of `exact_poses`
hybrid_speedup : (decode + exact) over that
hybrid_estimated : share of these poses that are estimated
hybrid_error : share of these poses that are misclassified
table_poses : 15 000, of the paper's Table 3
predicted_seconds : for `table_poses`, measured
exact_seconds : for `table_poses`, decoding included, scaled up from `exact_poses`
exact_poses : poses that the exact check was timed on
colliding_share : of these
fcl_seconds : for `table_poses`, without decoding, scaled without loss from one core and `fcl_poses`
    poses; None without python-fcl
fcl_poses : poses that python-fcl was timed on
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial

import numpy as np
import numpy.typing as npt

from app.benchmarks.detection import contacts_of_fcl, missing_peers
from app.benchmarks.measures import Row, median_seconds
from lcollision_core.bodies import LearnedBody, check_poses
from lcollision_core.embedding.bilevel import ROWS_PER_BLOCK
from lcollision_core.jobs import UNWATCHED, Job, available_cores
from lcollision_core.predictor import CollisionPredictor

FloatArray = npt.NDArray[np.float64]

BATCH = 500
TABLE_POSES = 15_000
"""Number of poses in the paper's Table 3."""

ERROR_BOUND = 1e-3

ROUNDS = 7
GRADIENT_ROUNDS = 60
FCL_POSES = 8
GEMM_SIZE = 1024


def time_predictor(
    model: LearnedBody,
    predictor: CollisionPredictor,
    n_poses: int,
    job: Job = UNWATCHED,
) -> list[Row]:
    """Time a model's predictor on the CPU and, if there is one, on the GPU.

    Parameters
    ----------
    model : decodes the poses
    predictor : of the model
    n_poses : for the exact check
    job : reports those poses, and is polled between batches
    """
    import torch

    latent = drawn_poses(model, TABLE_POSES)
    exact = _time_exact(model, latent[:n_poses], job)
    devices = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]
    return [
        _time_on(device, replace(predictor, device=device), latent, exact) | exact
        for device in devices
    ]


def drawn_poses(model: LearnedBody, n_poses: int) -> npt.NDArray[np.float32]:
    """Draw the first (n, D) samples of seed 0 from a model's latent box."""
    box = model.embedding.box
    blocks = range(-(-n_poses // ROWS_PER_BLOCK))
    return np.concatenate([box.draw(0, block) for block in blocks])[:n_poses]


def _time_exact(
    model: LearnedBody,
    latent: npt.NDArray[np.float32],
    job: Job,
) -> Row:
    """Return the fields of the exact and the hybrid verdict, common to all devices."""
    detector = model.detector
    # Compiling and building the trees are not timed.
    first = model.decode(latent[:BATCH])
    detector.are_colliding(first[:8])
    check_poses(model, latent[:8], ERROR_BOUND)
    decode = check = hybrid = 0.0
    n_colliding = n_estimated = n_wrong = 0
    for start in range(0, len(latent), BATCH):
        job.check()
        part = latent[start : start + BATCH]
        began = time.perf_counter()
        vertices = model.decode(part)
        decoded = time.perf_counter()
        colliding = detector.are_colliding(vertices)
        checked = time.perf_counter()
        verdicts = check_poses(model, part, ERROR_BOUND)
        hybrid += time.perf_counter() - checked
        decode += decoded - began
        check += checked - decoded
        n_colliding += int(colliding.sum())
        n_estimated += int((~verdicts.exact).sum())
        n_wrong += int((verdicts.colliding != colliding).sum())
        job.report(min(start + BATCH, len(latent)), len(latent))
    fcl = None
    if "python-fcl" not in missing_peers():
        faces = np.asarray(model.faces)
        fcl = median_seconds([partial(contacts_of_fcl, pose, faces) for pose in first[:FCL_POSES]])
    count = len(latent)
    return {
        "exact_ms_per_pose": 1e3 * check / count,
        "decode_ms_per_pose": 1e3 * decode / count,
        "hybrid_ms_per_pose": 1e3 * hybrid / count,
        "hybrid_speedup": (decode + check) / hybrid,
        "hybrid_estimated": n_estimated / count,
        "hybrid_error": n_wrong / count,
        "table_poses": TABLE_POSES,
        "exact_seconds": TABLE_POSES * (decode + check) / count,
        "exact_poses": count,
        "colliding_share": n_colliding / count,
        "fcl_seconds": None if fcl is None else fcl * TABLE_POSES / available_cores(),
        "fcl_poses": 0 if fcl is None else FCL_POSES,
    }


def _time_on(
    device: str, predictor: CollisionPredictor, latent: npt.NDArray[np.float32], exact: Row
) -> Row:
    import torch

    batch = latent[:BATCH]
    predictor.predict(batch)
    predicted = median_seconds([lambda: predictor.predict(batch)] * ROUNDS) / BATCH
    began = time.perf_counter()
    for start in range(0, len(latent), BATCH):
        predictor.predict(latent[start : start + BATCH])
    predicted_all = time.perf_counter() - began
    one = latent[:1].astype(np.float64)
    n_threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        predictor.logit_and_gradient(one)
        gradient = median_seconds([lambda: predictor.logit_and_gradient(one)] * GRADIENT_ROUNDS)
    finally:
        torch.set_num_threads(n_threads)
    return {
        "device": device,
        "preset": predictor.config.preset,
        "batch": BATCH,
        "cores": available_cores(),
        "us_per_pose": 1e6 * predicted,
        "gradient_ms": 1e3 * gradient,
        "speedup": exact["exact_seconds"] / TABLE_POSES / predicted,
        "gemm_fraction": predictor.flops(BATCH) / (BATCH * predicted) / _gemm_rate(device),
        "predicted_seconds": predicted_all,
    }


def _gemm_rate(device: str) -> float:
    """Return the floating-point operations per second of a large single-precision product."""
    import torch

    left = torch.rand((GEMM_SIZE, GEMM_SIZE), device=device)

    def multiply() -> None:
        # Fetching an entry from the device waits for the product.
        float((left @ left)[0, 0])

    multiply()
    return 2.0 * GEMM_SIZE**3 / median_seconds([multiply] * ROUNDS)
