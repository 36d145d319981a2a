"""The timeline panel: play, inspect and resolve a motion."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from PySide6.QtCore import QSize, Qt, QTimer, Slot
from PySide6.QtGui import QAction, QResizeEvent
from PySide6.QtWidgets import (
    QComboBox,
    QLayout,
    QMenu,
    QProgressBar,
    QSizePolicy,
    QToolButton,
    QWidget,
)

from app.view.theme import ICON_SIZE, NORMAL, TIGHT, give_icon
from app.window.layout import Docking, bring_up
from app.window.panels.timeline_strip import BETWEEN, TimelineStrip
from app.window.widgets import (
    ElidedLabel,
    NumberBox,
    described,
    hbox,
    labelled,
    push_button,
    signals_blocked,
    vbox,
    widget_of,
)
from lcollision_core.tasks.words import (
    counted,
    duration_text,
    height_text,
    joined,
    menu_text,
    say,
    say_number,
    spent_text,
    with_capital,
)

if TYPE_CHECKING:
    from app.editing.document import PoseDocument
    from app.editing.motion_resolve import ResolveProgress

_SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0)
_BUTTONS = ("colliding_before", "step_back", "play", "step_on", "colliding_next", "loop")
_LARGEST_EASING = 1000
_LEAST_WIDTH, _NARROW = 410, 650
_BAR_WIDTH, _PART_WIDTH = 64, 150
_WHOLE_BODY = "Whole body"


class TimelinePanel(QWidget):
    """Play the motion, show the results of its frames' checks, and resolve it.

    Parameters
    ----------
    document : whose timeline is shown
    actions : of commands, by key; triggered by the buttons

    Attributes
    ----------
    strip : the ruler and the strips below it
    clips, speed, easing, part : fields
    resolve : button that starts resolving the motion
    working : replaces it meanwhile, with the progress and the buttons `keep` and `cancel`
    """

    docking = Docking(
        "timeline",
        "&Timeline",
        "Ctrl+Alt+4",
        "Show or hide the timeline of a motion",
        Qt.DockWidgetArea.BottomDockWidgetArea,
    )

    def __init__(self, document: PoseDocument, actions: Mapping[str, QAction]) -> None:
        super().__init__()
        self._document, self._timeline = document, document.timeline
        self.strip = TimelineStrip()
        # As wide as its names; this many characters at least.
        clips = QComboBox(minimumContentsLength=5)
        clips.setSizeAdjustPolicy(QComboBox.SizeAdjustPolicy.AdjustToContents)
        self.clips = described(clips, "Which motion is on the timeline", "Motion")
        tip = "Playback speed; 100 % is the motion's own rate"
        self.speed = described(QComboBox(), tip, "Speed")
        for speed in _SPEEDS:
            self.speed.addItem(f"{100 * speed:g} %", speed)
        tip = "Whose deepest overlap the curve shows"
        self.part = described(QComboBox(minimumContentsLength=7), tip, "Deepest overlap of")
        # Names of a scene's parts are long, and differ at their ends.
        self.part.setMaximumWidth(_PART_WIDTH)
        self.part.view().setTextElideMode(Qt.TextElideMode.ElideLeft)
        tip = "Frames (at 30 per second) over which an edit eases in and out"
        self.easing = described(NumberBox(0, 0, _LARGEST_EASING), tip, "Ease edits over")
        tip = "The frame at the playhead, from 0, and its time"
        self.place = described(labelled("", "caption"), tip)
        self.place.setMinimumWidth(self.fontMetrics().horizontalAdvance("000 · 00.00 s"))
        self.facts = ElidedLabel("")
        self.facts.setObjectName("caption")
        self.bar = QProgressBar(textVisible=False)
        self.bar.setFixedWidth(_BAR_WIDTH)
        resolving = document.timeline.resolving
        tip = "Stop Resolve and keep the spans of frames that are resolved"
        self.keep = push_button("Keep so far", tip, resolving.keep_done)
        tip = "Stop Resolve and leave the motion as it was (Escape)"
        self.cancel = push_button("Cancel", tip, resolving.cancel)
        self._second, self._play = QTimer(self, interval=1000), actions["play"]
        self._lay_out(actions)
        timeline = self._timeline
        self.strip.frame_wanted.connect(timeline.go_to)
        self.strip.range_wanted.connect(timeline.set_range)
        self.clips.activated.connect(self._on_clip)
        self.speed.activated.connect(lambda: timeline.playback.set_speed(self.speed.currentData()))
        self.part.activated.connect(self._follow_checks)
        self.easing.valueChanged.connect(lambda frames: timeline.set_easing(int(frames)))
        self.easing.refused.connect(document.message)
        timeline.opened.connect(self._on_opened)
        timeline.arrived.connect(lambda: bring_up(self))
        timeline.moved.connect(self._follow_frame)
        timeline.checked.connect(self._follow_checks)
        timeline.playback.changed.connect(self._follow)
        timeline.range_changed.connect(self._follow)
        timeline.options_changed.connect(self._follow)
        timeline.options_changed.connect(self._follow_checks)
        timeline.resolving.changed.connect(self._follow_progress)
        self._second.timeout.connect(self._tell_checks)
        document.model_changed.connect(self._on_model)
        if document.has_model:
            self._on_model()
        self._on_opened()

    def _lay_out(self, actions: Mapping[str, QAction]) -> None:
        buttons = hbox(*(_button(actions[key]) for key in _BUTTONS), spacing=0)
        points = [_button(actions[key]) for key in ("in_point", "out_point")]
        ease = labelled("Ease", "caption")
        looks = QToolButton(popupMode=QToolButton.ToolButtonPopupMode.InstantPopup, autoRaise=True)
        give_icon(described(looks, "Onion skin and path", "Onion skin and path"), "onion")
        looks.setIconSize(QSize(ICON_SIZE, ICON_SIZE))
        menu = QMenu(looks)
        menu.setToolTipsVisible(True)
        menu.addActions([actions[key] for key in actions if key.startswith("onion_")])
        menu.addSeparator()
        menu.addAction(actions["trail"])
        looks.setMenu(menu)
        resolve = self.resolve = QToolButton(
            popupMode=QToolButton.ToolButtonPopupMode.MenuButtonPopup
        )
        resolve.setDefaultAction(actions["resolve_motion"])
        resolve.setToolButtonStyle(Qt.ToolButtonStyle.ToolButtonTextBesideIcon)
        resolve.setObjectName("filter")
        more = QMenu(resolve)
        more.setToolTipsVisible(True)
        more.addActions([actions[key] for key in ("resolve_motion", "resolve_range", "resolve")])
        resolve.setMenu(more)
        self.working = widget_of(hbox(self.bar, self.keep, self.cancel, spacing=TIGHT))
        # Only the strip grows in height.
        self.working.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Fixed)
        self.working.hide()
        top = hbox(
            *(self.clips, buttons, self.speed, self.place, None),
            *(hbox(*points, spacing=0), _button(actions["compare"]), looks),
        )
        below = hbox(
            *(self.part, self.facts, ease, self.easing, resolve, self.working),
            wide=self.facts,
        )
        page = vbox(
            *(top, below, self.strip),
            spacing=TIGHT,
            margins=(NORMAL, 0, NORMAL, TIGHT),
        )
        # Allow a width below that of all widgets; `resizeEvent` then hides some.
        page.setSizeConstraint(QLayout.SizeConstraint.SetNoConstraint)
        self.setLayout(page)
        self._least_height = page.minimumSize().height()
        self._left_out = (self.speed, self.place, *points, ease, self.easing)

    def minimumSizeHint(self) -> QSize:  # noqa: N802 - Qt's name
        """Ask for a width that fits beside the other panels on a small screen."""
        return QSize(_LEAST_WIDTH, self._least_height)

    def resizeEvent(self, event: QResizeEvent) -> None:  # noqa: N802 - Qt's name
        """Hide the less important widgets in a narrow window."""
        super().resizeEvent(event)
        self._leave_out()

    def _leave_out(self) -> None:
        is_wide = self.width() >= _NARROW
        for widget in self._left_out:
            widget.setVisible(is_wide)
        self.part.setVisible(is_wide or self._timeline.resolving.progress is None)

    # Following the timeline.

    @Slot()
    def _on_model(self) -> None:
        with signals_blocked(self.part):
            self.part.clear()
            self.part.addItem(_WHOLE_BODY, None)
            for number, name in enumerate(self._document.model.domain_names):
                self.part.addItem(menu_text(name), number)

    @Slot()
    def _on_opened(self) -> None:
        timeline = self._timeline
        motion = timeline.motion
        with signals_blocked(self.clips):
            self.clips.clear()
            self.clips.addItems([menu_text(name) for name in timeline.motions])
            if motion is not None and motion.name in timeline.motions:
                self.clips.setCurrentIndex(list(timeline.motions).index(motion.name))
        self.strip.set_motion(np.zeros(0) if motion is None else motion.times)
        self.follow_motion()
        self._follow()
        self._follow_checks()

    def follow_motion(self) -> None:
        """Show the panel in front if the body has a motion, else hide it."""
        dock = self.parentWidget()
        if dock is None:
            return
        if not self._timeline.motions:
            dock.hide()
        elif dock.isHidden():
            bring_up(self)

    @Slot(int)
    def _on_clip(self, row: int) -> None:
        self._timeline.choose(list(self._timeline.motions)[row])

    @Slot()
    def _follow_frame(self) -> None:
        """Follow the playhead only: this is called for each frame played."""
        timeline = self._timeline
        motion, frame, playback = timeline.motion, timeline.frame, timeline.playback
        self.strip.set_frame(frame)
        if motion is None or frame is None:
            self.place.setText("")
            return
        self.place.setText(f"{frame} · {motion.times[frame]:.2f} s")
        if playback.playing and playback.rate:
            rate, whole, n = playback.rate, motion.rate * playback.speed, playback.n_dropped
            text = say("{rate:.0f} of {whole:g} frames a second", rate=rate, whole=whole)
            if n:
                text = say("{speed}, {n} dropped", speed=text, n=n)
            self.facts.setText(text)

    @Slot()
    def _follow(self) -> None:
        """Show the current range, speed and easing."""
        timeline = self._timeline
        self.strip.set_range(timeline.first, timeline.last)
        with signals_blocked(self.speed), signals_blocked(self.easing):
            self.speed.setCurrentIndex(self.speed.findData(timeline.playback.speed))
            self.easing.setValue(timeline.easing)
        give_icon(self._play, "pause" if timeline.playing else "play")
        self._follow_frame()
        if not timeline.playing:
            self._tell_checks()

    @Slot()
    def _follow_checks(self) -> None:
        timeline = self._timeline
        if timeline.motion is None:
            return
        checks, part = timeline.shown_checks, self.part.currentData()
        self.strip.set_depths(checks.deepest)
        self.strip.set_between(checks.between)
        name = "" if part is None else self._document.model.domain_names[part]
        depths = np.where(np.isnan(checks.deepest), np.nan, checks.parts[:, part or 0])
        self.strip.set_curve(checks.deepest if part is None else depths, name)
        self.strip.set_estimate(checks.estimate if self._document.model.has_predictor else None)
        self.strip.set_resolved(timeline.resolving.spans)
        if not timeline.playing:
            self._tell_checks()

    @Slot()
    def _follow_progress(self) -> None:
        """Show the progress of Resolve in place of its button."""
        progress = self._timeline.resolving.progress
        is_working = progress is not None
        if is_working != self._second.isActive():
            (self._second.start if is_working else self._second.stop)()
            self.working.setVisible(is_working)
            self.resolve.setVisible(not is_working)
            self.keep.setEnabled(False)
            self._leave_out()
        if progress is not None:
            # A total of 0 shows a busy indicator.
            self.bar.setRange(0, progress.total)
            self.bar.setValue(progress.done)
            resolving = self._timeline.resolving
            self.keep.setEnabled(bool(resolving.spans) and not resolving.is_ending)
        if not self._timeline.playing:
            self._tell_checks()

    def _tell_progress(self, progress: ResolveProgress) -> str:
        if self._timeline.resolving.is_ending:
            return "Stopping…"
        left, frames = progress.seconds_left, counted(progress.total, "frame", "frames")
        if left is not None:
            done, duration = progress.done, duration_text(left)
            return say("{n} of {frames}, {time} left", n=done, frames=frames, time=duration)
        spent = spent_text(progress.seconds)
        if progress.total:
            return say("0 of {frames}, {time} so far", frames=frames, time=spent)
        return say("Checking frames, {time} so far", time=spent)

    @Slot()
    def _tell_checks(self) -> None:
        timeline = self._timeline
        progress = timeline.resolving.progress
        if progress is not None:
            self.facts.setText(self._tell_progress(progress))
            return
        if timeline.motion is None:
            self.facts.setText("Reading the motion…" if timeline.is_reading else "")
            return
        checks = timeline.shown_checks
        n = len(checks.deepest)
        deep = np.nan_to_num(checks.deepest)
        n_colliding, n_between = int((deep > 0.0).sum()), int(checks.between.sum())
        frames, facts, are_all = (
            counted(n, "frame", "frames"),
            ["no collisions"],
            checks.n_checked == n,
        )
        if n_colliding:
            colliding = say("{n} of {frames}", n=n_colliding, frames=frames)
            facts = [
                say_number(
                    n_colliding,
                    "{frames} collides, at most {depth} deep",
                    "{frames} collide, at most {depth} deep",
                    frames=colliding if are_all else n_colliding,
                    depth=height_text(float(deep.max())),
                )
            ]
        if n_between:
            collisions = counted(n_between, "collision", "collisions")
            facts.append(say("{mark} {n} between frames", mark=BETWEEN, n=collisions))
        heads = ["as it was read"] if timeline.comparing else []
        if not are_all and (checks.n_checked or not heads):
            heads.append(say("{n} of {frames} checked", n=checks.n_checked, frames=frames))
        if checks.n_checked:
            heads.append(joined(facts))
        text, left_out = with_capital(": ".join(heads)), checks.left_out
        if left_out.frames:
            # On its own line, to be visible in a small window; the tool tip has the details.
            n, depth = left_out.frames, height_text(left_out.deepest, 2)
            frames = counted(n, "frame", "frames")
            if left_out.step > 1:
                frames = say("{n} of {searched} searched", n=n, searched=left_out.searched)
            line = say("Not counted in {frames}, up to {depth}", frames=frames, depth=depth)
            text = f"{text}\n{line}"
        more = [left_out.sentence(self._document.model.rules), *timeline.kept_sentences()]
        self.facts.setText(text, "\n".join(filter(None, more)))


def _button(action: QAction) -> QToolButton:
    button = QToolButton()
    button.setDefaultAction(action)
    button.setIconSize(QSize(ICON_SIZE, ICON_SIZE))
    button.setAutoRaise(True)
    button.setFocusPolicy(Qt.FocusPolicy.TabFocus)
    return button
