# SPDX-License-Identifier: GPL-3.0-or-later
"""Long work: in the interface a little at each tick, with progress and Esc."""

import time

import bpy

from . import link
from .client import EngineCancelled, EngineError
from .scene import Caution, SceneError

_TICK, _SHARE = 0.05, 0.6
"""Seconds between two ticks, and the share of that spent working."""


class ModalOperator:
    """An operator whose work is `steps`: at once by a script, tick by tick in the interface."""

    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set:
        """Run all steps."""
        self._steps = self.steps(context, context.scene.lcollision)
        while True:
            done = self._step()
            if done is not None:
                return done
            if self._text.startswith("\0"):
                time.sleep(0.002)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set:
        """Start the steps as a modal operator."""
        self._steps = self.steps(context, context.scene.lcollision)
        manager = context.window_manager
        self._timer = manager.event_timer_add(_TICK, window=context.window)
        manager.modal_handler_add(self)
        link.n_going_on += 1
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set:
        """Run steps for a part of a tick."""
        if event.type == "ESC":
            self.cancel(context)
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        until = time.monotonic() + _TICK * _SHARE
        while time.monotonic() < until:
            try:
                done = self._step()
            except BaseException:
                self._end(context)
                raise
            if done is not None:
                self._end(context)
                return done
            if self._text.startswith("\0"):
                break
        context.workspace.status_text_set(f"{self._text.strip(chr(0))}    Esc: cancel")
        return {"RUNNING_MODAL"}

    def cancel(self, context: bpy.types.Context) -> None:
        """End without a result, by Esc or by Blender."""
        try:
            self._steps.close()
        finally:
            self._end(context)

    def _end(self, context: bpy.types.Context) -> None:
        context.window_manager.event_timer_remove(self._timer)
        context.workspace.status_text_set(None)
        link.n_going_on -= 1

    def _step(self) -> set | None:
        """Run one step; return the operator's result at the end."""
        try:
            self._text = next(self._steps)
        except StopIteration as end:
            self.report({"WARNING" if isinstance(end.value, Caution) else "INFO"}, end.value)
            return {"FINISHED"}
        except EngineCancelled:
            return {"CANCELLED"}
        except (EngineError, SceneError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        except ReferenceError:
            self.report({"ERROR"}, "The character is gone")
            return {"CANCELLED"}
        return None
