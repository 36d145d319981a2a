"""Code for processes that are killed or interrupted at a reproducible point."""

from __future__ import annotations


def after_checkpoint(number: int, signal: str = "SIGKILL") -> str:
    """Return code that makes a process write checkpoints as often as possible and then stops it.

    Parameters
    ----------
    number : of checkpoints after which the signal is sent
    signal : its name
    """
    return (
        "import os, signal\n"
        "from lcollision_core.embedding import training_run as checkpoint\n"
        "checkpoint._SECONDS_BETWEEN_WRITES = -1.0\n"
        "put, n_written = checkpoint.Checkpoint.put, 0\n"
        "def put_and_stop(*arguments):\n"
        "    global n_written\n"
        "    put(*arguments)\n"
        "    n_written += 1\n"
        f"    if n_written == {number}:\n"
        f"        os.kill(os.getpid(), signal.{signal})\n"
        "checkpoint.Checkpoint.put = put_and_stop\n"
    )
