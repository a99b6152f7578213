"""A history of touches on disk: stored, and read back bit for bit."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hqp_grasp.errors import InputError, ResultsError
from hqp_grasp.files import digest, whole_file
from hqp_grasp.grasp import Contact, Frame, Grasp, Miss, Missed, Touch

FORMER = ("confidence",)  # of contacts in older files; nothing ever read it
UNREADABLE = (  # what comes of JSON that holds something else
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    OverflowError,
    RecursionError,
)
GRASP = ("q", "jacobian", "hessian", "rolling", "coupling", "offset")


def save_history(path: str | Path, history: Sequence[Touch]) -> None:
    """Write `history` as JSON, whole or not at all; numbers keep their bits.

    Raises ResultsError where the file cannot be written.
    """
    touches = [_plain(touch) for touch in history]
    _require_one_hand(history)
    text = json.dumps({"sha256": digest(touches).hex(), "touches": touches})
    with whole_file(path) as part:
        part.write_text(text)


def load_history(path: str | Path) -> tuple[Touch, ...]:
    """Read what `save_history` wrote; raise ResultsError where it is something else, or damaged.

    Older files are a list of touches, without a checksum.
    """
    try:
        text = json.loads(Path(path).read_text())
        told, touches = (
            (str(text["sha256"]), text["touches"]) if isinstance(text, dict) else (None, text)
        )
        history = tuple(_touch(touch) for touch in touches)
        _require_one_hand(history)
    except OSError as error:
        raise ResultsError(f"{path} cannot be read: {error.strerror or error}") from error
    except UNREADABLE as error:
        raise ResultsError(f"{path} is no history of touches: {error!r}") from error
    if told is not None and told != digest(touches).hex():
        raise ResultsError(f"{path} is damaged: its checksum does not fit its touches")
    return history


def _require_one_hand(history: Sequence[Touch]) -> None:
    """Raise InputError unless all touches are of the same joints, and the same contacts."""
    joints = {len(touch.q_target) for touch in history}
    if len(joints) > 1:
        raise InputError(f"its touches are of hands with {sorted(joints)} joints")
    grasps = ((i, touch.felt) for i, touch in enumerate(history) if isinstance(touch.felt, Grasp))
    felt = {i: [(contact.name, contact.body) for contact in g.contacts] for i, g in grasps}
    first = next(iter(felt), None)
    for i, names in felt.items():
        if names != felt[first]:  # type: ignore[index]
            raise InputError(
                f"touch {i} felt {len(names)} contacts {names}, touch {first} "
                f"{len(felt[first])} {felt[first]}: a history is of one hand"  # type: ignore[index]
            )


def _plain(touch: Touch) -> dict[str, object]:
    felt: dict[str, object]
    if isinstance(touch.felt, Missed):
        felt = {"reason": touch.felt.reason.name, "where": touch.felt.where}
    else:
        grasp = touch.felt
        felt = {name: _list(getattr(grasp, name)) for name in GRASP}
        felt["other_links"] = list(grasp.other_links)
        for several in ("contacts", "frames"):
            felt[several] = [
                {name: _list(value) for name, value in vars(each).items()}
                for each in getattr(grasp, several)
            ]
    return {"q_target": touch.q_target.tolist(), "felt": felt}


def _touch(plain: dict[str, dict[str, object]]) -> Touch:
    felt = dict(plain["felt"])
    if "reason" in felt:
        return Touch(plain["q_target"], Missed(Miss[str(felt["reason"])], str(felt["where"])))  # type: ignore[arg-type]
    contacts = [
        Contact(**{name: value for name, value in contact.items() if name not in FORMER})
        for contact in felt.pop("contacts")  # type: ignore[attr-defined]
    ]
    frames = tuple(Frame(**frame) for frame in felt.pop("frames", ()))  # type: ignore[attr-defined]
    felt["other_links"] = tuple(felt["other_links"])  # type: ignore[arg-type]
    return Touch(
        plain["q_target"],  # type: ignore[arg-type]
        Grasp(contacts=tuple(contacts), frames=frames, **felt),  # type: ignore[arg-type]
    )


def _list(value: object) -> object:
    if isinstance(value, np.ndarray):
        return value.tolist()
    return list(value) if isinstance(value, tuple) else value
