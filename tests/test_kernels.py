"""The package runs where compiled functions cannot be kept, and says how they can."""

import subprocess
import sys

import pytest

from hqp_grasp import kernels
from hqp_grasp.hierarchy import compiled

UNWRITABLE = """
import tempfile
def refuse(*args, **kwargs): raise PermissionError(13, "Permission denied")
tempfile.TemporaryFile = refuse  # by which numba tells whether a folder can be written
import hqp_grasp as hg
print(hg.Level.equal([[1.0]], [2.0]).lower)  # a compiled function looks at it
"""


def double(x):
    return 2.0 * x


@pytest.fixture
def no_folder(monkeypatch):
    def refuse(*args, **kwargs):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("tempfile.TemporaryFile", refuse)
    monkeypatch.setattr(kernels, "homeless", [])


def test_a_function_that_cannot_be_kept_is_compiled_all_the_same_and_it_is_said_once(
    no_folder, capsys
):
    kernel = kernels.njit(cache=True, error_model="numpy")(double)
    assert kernel(3.0) == 6.0 and kernel.signatures
    kernels.njit(cache=True)(double)
    assert capsys.readouterr().err == kernels.HOMELESS + "\n"
    assert "set NUMBA_CACHE_DIR to a folder that can be written" in kernels.HOMELESS
    assert kernels.homeless == [__name__] * 2


def test_where_there_is_a_folder_nothing_is_said_and_the_function_is_kept(capsys):
    kernel = kernels.njit(cache=True)(double)
    kernel(3.0)
    assert kernel.stats.cache_path and capsys.readouterr().err == ""


def test_another_error_of_numba_is_not_taken_for_a_missing_folder(monkeypatch):
    def fails(**options):
        raise RuntimeError("no compiler")

    monkeypatch.setattr("numba.njit", fails)
    with pytest.raises(RuntimeError, match="no compiler"):
        kernels.njit(cache=True)(double)


def test_the_package_works_where_neither_package_nor_home_can_be_written():
    said = subprocess.run(
        [sys.executable, "-c", UNWRITABLE], capture_output=True, text=True, check=True
    )
    assert said.stdout == "[2.]\n"
    assert [line for line in said.stderr.splitlines() if line] == [
        kernels.HOMELESS,
        compiled.ANEW.ljust(80),
    ]
