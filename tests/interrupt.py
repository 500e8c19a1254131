"""An interrupt where no keystroke would ever hit."""

from __future__ import annotations

import signal
import sys


class Interrupt:
    """While this runs, SIGINT comes when the main thread begins its n-th line."""

    def __init__(self, line: int) -> None:
        self.left = line

    def __enter__(self) -> None:
        self.before = sys.gettrace()
        sys.settrace(self._trace)

    def __exit__(self, *_) -> None:
        sys.settrace(self.before)

    def _trace(self, frame, event, argument):
        if event == "line":
            self.left -= 1
            if self.left == 0:
                sys.settrace(None)
                signal.raise_signal(signal.SIGINT)
        return self._trace
