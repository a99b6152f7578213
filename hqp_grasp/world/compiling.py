"""The one door to MuJoCo's compiler: what is read is what is on disk."""

from __future__ import annotations

import re
from pathlib import Path

import mujoco
import numpy as np

from hqp_grasp.errors import InputError, ModelError

UNUSED = 0.1  # [–] share of an OBJ's vertices in none of its faces, above which it was cut off


def read_afresh() -> None:
    """Have MuJoCo read every file again, whenever it needs it.

    It would keep meshes, textures and height fields by their name and the second they were
    written in, and give back what another file of that name and time held. The kept ones save a
    third of the time that a robot of 26 meshes takes, 0.2 s.
    """
    mujoco.mj_setCacheCapacity(mujoco.mj_getCache(), 0)


def compiled_spec(spec: mujoco.MjSpec, failed: str) -> mujoco.MjModel:
    """`spec` as MuJoCo compiles it from the files on disk now.

    Raises InputError for what does not compile, after the words `failed`; and for an OBJ that ends
    early, which MuJoCo, alone of all kinds of files, takes as far as it goes.
    """
    read_afresh()
    try:
        model = spec.compile()
    except ModelError:  # a ValueError too, and says more
        raise
    except (ValueError, OSError) as error:
        told = f"{failed}: {' '.join(str(error).split())}"
        named = re.search(r"Element name '(.*)', id", told)
        mesh = spec.mesh(named[1]) if named else None
        if mesh is not None and mesh.file not in told:
            told += f" (its file is {mesh.file})"
        raise InputError(told) from error
    for m in range(model.nmesh):
        start = int(model.mesh_pathadr[m])
        path = Path(model.paths[start:].split(b"\0")[0].decode()) if start >= 0 else Path()
        if path.suffix.lower() == ".obj" and path.is_file():
            fault = _cut_off(path.read_bytes())
            if fault:
                raise InputError(f"{path} {fault}; was it cut off? Write it again, whole")
    return model


def _cut_off(data: bytes) -> str:
    """How an OBJ shows that its end is missing.

    A cut between two of its last faces shows in nothing, nor changes a convex hull.
    """
    faces = re.findall(rb"^[ \t]*f[ \t](.*)", data, re.MULTILINE)
    if not faces:
        return "has no faces"
    last = data.split(b"\n")[-1].split()
    if last and last[0] in (b"v", b"f") and len(last) < 4:
        return f"ends amid the line {b' '.join(last).decode()!r}"
    count = len(re.findall(rb"^[ \t]*v[ \t]", data, re.MULTILINE))
    corners = np.array(re.findall(rb"(?<!\S)-?\d+", b" ".join(faces)), dtype=int)
    used = len(np.unique(np.where(corners < 0, corners + count + 1, corners)))
    if used < (1.0 - UNUSED) * count:
        return f"has {count} vertices, of which its faces use {used}"
    return ""
