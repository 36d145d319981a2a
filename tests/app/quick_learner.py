"""``python -m tests.app.quick_learner WORK_FOLDER``: the learner, reduced to some seconds."""

from __future__ import annotations

import os
import sys
import time
from dataclasses import replace

from app.work import learner
from lcollision_core.embedding.training_run import EmbeddingConfig
from lcollision_core.predictor import PRESETS
from lcollision_core.tasks.learning import EFFORTS, Effort, Pace

EFFORTS.update(
    dict.fromkeys(
        EFFORTS,
        Effort(
            16,
            EmbeddingConfig(
                n_domains=2, n_domain_codes=3, level1_epochs=10, level2_epochs=5, held_out_stride=0
            ),
            256,
            replace(PRESETS["paper"], epochs=2, average_passes=0.0),
            n_judged=40,
        ),
    )
)


# On a busy machine, the tests would wait for a process of low priority.
learner._NICENESS = 1


def slow_down() -> None:
    """Slow down each progress report, so that a test can act in between."""
    seconds = float(os.environ.get("SECONDS_PER_STEP", "0"))
    report = Pace.report

    def slowly(*arguments: object) -> None:
        report(*arguments)  # type: ignore[arg-type]
        time.sleep(seconds)

    Pace.report = slowly  # type: ignore[method-assign]


if __name__ == "__main__":
    slow_down()
    sys.exit(learner.main(sys.argv[1:]))
