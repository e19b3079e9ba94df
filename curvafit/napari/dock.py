"""What the widgets share: work in a thread with progress, a button that stops it, and a sentence at the end."""

from __future__ import annotations

import threading
from abc import abstractmethod
from collections.abc import Callable
from typing import Any

from magicgui.widgets import Container, Label, ProgressBar, PushButton
from napari.qt.threading import create_worker
from qtpy.QtCore import QTimer
from qtpy.QtWidgets import QSizePolicy

from curvafit.core.runtime import Progress

#: Milliseconds between looks at the work's progress.
_PAUSE = 100


class Stopped(Exception):
    """The user stopped the work."""


class Dock(Container):
    """A widget that works: `prepare` reads the choices, its result runs in a thread, `show_result` takes what it gives.

    The widgets of the choices come first, then the buttons, the progress and a sentence.
    """

    def __init__(self, viewer: Any, choices: list[Any], verb: str) -> None:
        self.viewer = viewer
        self.run_button, self.stop_button = PushButton(text=verb), PushButton(text="Stop", enabled=False)
        self.progress, self.status = ProgressBar(value=0, max=100, visible=False), Label(value="")
        buttons = Container(widgets=[self.run_button, self.stop_button], layout="horizontal", labels=False)
        super().__init__(widgets=[*choices, buttons, self.progress, self.status])
        self.status.native.setWordWrap(True)
        self.status.native.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.MinimumExpanding)
        self.run_button.changed.connect(self.run)
        self.stop_button.changed.connect(self.stop)
        self._stopping, self._told, self.worker = threading.Event(), ("", 0.0), None
        self._timer = QTimer(self.native)
        self._timer.setInterval(_PAUSE)
        self._timer.timeout.connect(self._show_progress)
        self.native.destroyed.connect(self._stopping.set)

    @abstractmethod
    def prepare(self) -> Callable[[Progress], Any]:
        """Return the work, by the choices; raise ValueError where they are none."""

    @abstractmethod
    def show_result(self, result: Any) -> str:
        """Show the result of the work, and return a sentence on it."""

    def run(self) -> None:
        """Begin the work, or say why not."""
        try:
            work = self.prepare()
        except (ValueError, ImportError) as reason:
            self.say(f"{reason}.")
            return
        self._stopping.clear()
        self._told = ("beginning", 0.0)
        self.run_button.enabled, self.stop_button.enabled = False, True
        self.progress.visible = True
        self._show_progress()
        self._timer.start()
        connect = {"returned": self._end, "errored": self._fail, "finished": self._finish}
        self.worker = create_worker(work, self._hear, _connect=connect, _ignore_errors=True)

    def stop(self) -> None:
        """Stop the work at its next step."""
        self._stopping.set()
        self.say("Stopping.")

    def say(self, text: str) -> None:
        """Show a sentence."""
        self.status.value = text[:1].upper() + text[1:]

    def _hear(self, text: str, share: float) -> None:
        """Note how far the work is, in its thread."""
        if self._stopping.is_set():
            raise Stopped
        self._told = (text, share)

    def _show_progress(self) -> None:
        text, share = self._told
        self.progress.value = round(100 * share)
        if not self._stopping.is_set():
            self.say(f"{text} …")

    def _end(self, result: Any) -> None:
        self._timer.stop()
        try:
            self.say("Stopped." if self._stopping.is_set() else self.show_result(result))
        except (ValueError, OSError) as reason:
            self.say(f"{reason}.")

    def _fail(self, error: Exception) -> None:
        self._timer.stop()
        if isinstance(error, Stopped):
            self.say("Stopped.")
        elif isinstance(error, (ValueError, ImportError, MemoryError)):
            self.say(f"{error}.")
        else:
            self.say(f"{type(error).__name__}: {error}.")
            raise error

    def _finish(self) -> None:
        self._timer.stop()
        self.run_button.enabled, self.stop_button.enabled = True, False
        self.progress.visible = False
