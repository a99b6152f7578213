"""Says on the terminal, once, that the solver is being compiled: it would be silent for long."""

from __future__ import annotations

import sys

from numba.core import event


class _Notice(event.Listener):
    """One line on stderr at the first compilation of a function of this package."""

    def __init__(self) -> None:
        self.told = False

    def on_start(self, event: event.Event) -> None:
        function = event.data["dispatcher"].py_func
        if not self.told and function.__module__.startswith("hqp_grasp."):
            self.told = True
            print(
                "hqp_grasp: compiling the solver, once (10 to 20 seconds); the result is cached",
                file=sys.stderr,
                flush=True,
            )

    def on_end(self, event: event.Event) -> None:
        """Nothing to say."""


NOTICE = _Notice()  # numba calls it when it compiles, not when it loads from its cache
event.register("numba:compile", NOTICE)
