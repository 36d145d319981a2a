"""The files in `tests/data` match the code that makes them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.core.motion.swings import swinging_body
from tests.rigged_shapes import write_gltf
from tests.small_models import LEVEL2_RATES, SWING, stored, trained


def test_the_stored_files_are_what_is_made_anew(tmp_path: Path) -> None:
    assert write_gltf(swinging_body(), tmp_path / SWING.name).read_bytes() == SWING.read_bytes()
    for name in LEVEL2_RATES:
        old, new = stored(name), trained(name)
        assert old.card == new.card
        assert old.topology == new.topology
        known = [model.embedding.decode(model.known_poses) for model in (old, new)]
        # The order of summation in training depends on the processor.
        np.testing.assert_allclose(known[0], known[1], atol=1e-3)
        assert np.ptp(known[0], axis=0).max() > 0.5
