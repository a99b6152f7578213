"""The command line of the package: python -m hqp_grasp COMMAND; --help lists the commands."""

from __future__ import annotations

import sys
from pathlib import Path

from tyro.conf import Positional
from tyro.extras import SubcommandApp

from hqp_grasp.errors import HqpGraspError
from hqp_grasp.experiments.view import HOST, PORT, serve

app = SubcommandApp()


@app.command
def view(
    folder: Positional[Path],
    /,
    compare: Path | None = None,
    host: str = HOST,
    port: int = PORT,
) -> None:
    """Show a results folder in the browser: any trial, any probe, failures by kind.

    Args:
        folder: Where a scenario left its results.
        compare: A second folder of the same seed, whose robot is drawn beside as a ghost.
        host: Address to listen on; other machines can look on where it is not the loopback.
        port: Port to listen on; 0 takes any free one.
    """
    serve(folder, compare, host, port)


if __name__ == "__main__":
    try:
        app.cli(prog="python -m hqp_grasp")
    except HqpGraspError as error:
        sys.exit(f"hqp_grasp: {error}")
