"""The canvas fills its widget."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[3]

DRAW = """
import time
from PySide6.QtWidgets import QApplication
from app.view.canvas import Canvas

application = QApplication([])
canvas = Canvas(lambda: None)
canvas.set_background("white")
canvas.resize(271, 271)
canvas.show()
end = time.monotonic() + 200
while not canvas.is_settled and time.monotonic() < end:
    application.processEvents()
picture = canvas.grabFramebuffer()
side = range(picture.width())
print(picture.width(), picture.height(), len({picture.pixel(x, y) for x in side for y in side}))
canvas.shut_down()
"""


def test_a_picture_fills_the_canvas_at_a_fractional_scale() -> None:
    environment = {**os.environ, "QT_SCALE_FACTOR": "1.5"}
    words = [sys.executable, "-c", DRAW]
    drawn = subprocess.run(
        words, cwd=ROOT, env=environment, capture_output=True, text=True, check=True
    )
    # 271 x 1.5 is 406.5: Qt's framebuffer has 407 rows, all of one colour.
    assert drawn.stdout.split() == ["407", "407", "1"]
