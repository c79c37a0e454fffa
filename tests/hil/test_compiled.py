"""Compiling decides how fast a run is, never whether it happens or what it computes."""

import stat
import subprocess

import casadi as ca
import numpy as np
import pytest

from hil import compiled
from joint_firmware.laws import DriveLaw
from plant.actuators.bank import Symbols
from plant.actuators.model import ActuatorModel
from robots import description

ACTUATORS = Symbols([ActuatorModel.of(joint.actuator) for joint in description.load("hume").joints], 1 / 12000).step()
FUNCTION = ca.Function("tested", [x := ca.SX.sym("x", 3)], [ca.sin(x) * x[0] + ca.floor(x[1]) / 3.0])

VERSION = b'if [ "$1" = --version ]; then echo "broken 1.0"; exit 0; fi\n'  # of a stand-in for a compiler
needs_compiler = pytest.mark.skipif(compiled.compiler() is None, reason="no C compiler here")


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """A cache of the test's own; the compiler is looked up anew in the test and after it."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    look_up = compiled.compiler
    look_up.cache_clear()
    yield tmp_path / "cache" / "hume-hil"
    look_up.cache_clear()


@pytest.fixture
def calls(monkeypatch):
    """Commands that were run."""
    made = []
    run = subprocess.run

    def noted(command, **options):
        made.append(command)
        return run(command, **options)

    monkeypatch.setattr(subprocess, "run", noted)
    return made


def compilations(calls):
    return [command for command in calls if "-shared" in command]


def with_compiler(tmp_path, monkeypatch, script):
    """Only ``script`` answers to the name of cc."""
    folder = tmp_path / "bin"
    folder.mkdir()
    cc = folder / "cc"
    cc.write_bytes(b"#!/bin/sh\n" + script)
    cc.chmod(cc.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", str(folder))


def works(function):
    values = np.array([0.3, -7.7, 1e9])
    assert np.array(function(values)).tobytes() == np.array(FUNCTION(values)).tobytes()
    return True


def is_compiled(function):
    return function.class_name() == "External"


# --- results ------------------------------------------------------------------------------------------------


@needs_compiler
@pytest.mark.parametrize("function", [DriveLaw("PID_m").function, ACTUATORS], ids=lambda f: f.name())
def test_compiled_and_interpreted_results_are_equal_to_the_bit(function):
    fast = compiled.compile_function(function)
    assert is_compiled(fast)
    rng = np.random.default_rng(11)
    for scale in (1e-2, 1.0, 1e4):
        for _ in range(100):
            values = [scale * rng.normal(size=function.size_in(i)) for i in range(function.n_in())]
            for ours, theirs in zip(function(*values), fast(*values), strict=True):
                assert np.array(ours).tobytes() == np.array(theirs).tobytes()


# --- cache --------------------------------------------------------------------------------------------------


@needs_compiler
def test_a_function_is_compiled_once(cache, calls):
    for _ in range(3):
        assert works(compiled.compile_function(FUNCTION))
    assert len(compilations(calls)) == 1
    assert [path.suffix for path in cache.iterdir()] == [".so"]
    assert cache.stat().st_mode & 0o777 == 0o700


@needs_compiler
def test_another_function_of_the_same_name_is_another_entry(cache, calls):
    y = ca.SX.sym("y", 3)
    assert works(compiled.compile_function(FUNCTION))
    other = compiled.compile_function(ca.Function("tested", [y], [2 * y]))
    assert np.array(other([1.0, 2.0, 3.0])).ravel().tolist() == [2.0, 4.0, 6.0]
    assert len(compilations(calls)) == len(list(cache.iterdir())) == 2


@needs_compiler
def test_another_compiler_is_another_entry(cache, calls, monkeypatch):
    compiled.compile_function(FUNCTION)
    monkeypatch.setattr(compiled, "compiler", lambda version=compiled.compiler(): version + " (patched)")
    compiled.compile_function(FUNCTION)
    assert len(compilations(calls)) == 2


@needs_compiler
@pytest.mark.parametrize("keep", [slice(0, 0), slice(0, 100), slice(0, -1), slice(1, None)])
def test_an_entry_that_is_not_whole_is_built_again(cache, calls, keep):
    compiled.compile_function(FUNCTION)
    (entry,) = cache.iterdir()
    whole = entry.read_bytes()
    entry.unlink()  # a new file: what is loaded already must not change
    entry.write_bytes(whole[keep])
    assert works(compiled.compile_function(FUNCTION))
    assert len(compilations(calls)) == 2
    assert len(entry.read_bytes()) == len(whole)


# --- no compiler, or a broken one ---------------------------------------------------------------------------


def test_without_a_compiler_the_function_is_its_own_answer(tmp_path, monkeypatch, cache):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert compiled.compiler() is None
    assert compiled.compile_function(FUNCTION) is FUNCTION
    assert not cache.exists()


@pytest.mark.parametrize(
    "script",
    [
        b"exit 1\n",  # not even a version
        b"exit 0\n",  # an empty version
        b"kill -9 $$\n",
        VERSION + b"exit 1\n",  # headers or linker missing
        VERSION + b"exit 0\n",  # says it did, but did not
        VERSION + b'while [ "$1" != -o ]; do shift; done; echo garbage > "$2"\n',
        b"printf '\\377\\376 1.0\\n'\n",  # a version that is not UTF-8, and no output
    ],
    ids=["version fails", "version is empty", "killed", "fails", "no output", "garbage", "not UTF-8"],
)
def test_a_broken_compiler_costs_speed_only(tmp_path, monkeypatch, script):
    with_compiler(tmp_path, monkeypatch, script)
    assert compiled.compile_function(FUNCTION) is FUNCTION
    assert compiled.compile_function(FUNCTION) is FUNCTION  # also with what the first try may have left


def test_a_compiler_that_cannot_be_run_costs_speed_only(tmp_path, monkeypatch):
    with_compiler(tmp_path, monkeypatch, b"")
    (tmp_path / "bin" / "cc").write_bytes(b"\x7fELF of another machine")
    assert compiled.compile_function(FUNCTION) is FUNCTION


def test_a_compiler_that_hangs_is_given_up(monkeypatch):
    version = "/usr/bin/cc: some version"
    monkeypatch.setattr(compiled, "compiler", lambda: version)
    seen = []

    def hang(command, timeout, **_):
        seen.append(timeout)
        raise subprocess.TimeoutExpired(command, timeout)

    monkeypatch.setattr(subprocess, "run", hang)
    assert compiled.compile_function(FUNCTION) is FUNCTION
    assert seen and seen[0] <= 120


# --- no cache -----------------------------------------------------------------------------------------------


def fail(error):
    def raising(*_, **__):
        raise error

    return raising


@needs_compiler
def test_a_cache_that_cannot_be_made_is_done_without(cache, calls):
    cache.parent.write_text("a file is in the way")
    for _ in range(2):
        function = compiled.compile_function(FUNCTION)
        assert is_compiled(function) and works(function)
    assert len(compilations(calls)) == 2


@needs_compiler
def test_a_user_without_home_has_no_cache(monkeypatch, calls):
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(compiled.Path, "home", fail(RuntimeError("Could not determine home directory.")))
    assert compiled.cache_directory() is None
    assert is_compiled(compiled.compile_function(FUNCTION))


@needs_compiler
@pytest.mark.parametrize("mode", [0o770, 0o707, 0o777])
def test_a_cache_that_others_can_write_to_is_neither_read_nor_written(cache, calls, mode):
    compiled.compile_function(FUNCTION)
    (entry,) = cache.iterdir()
    cache.chmod(mode)
    before = entry.stat().st_mtime_ns
    assert compiled.cache_directory() is None
    assert is_compiled(compiled.compile_function(FUNCTION))
    assert len(compilations(calls)) == 2 and entry.stat().st_mtime_ns == before


def test_a_cache_of_another_user_is_not_used(cache, monkeypatch):
    monkeypatch.setattr(compiled.os, "getuid", lambda uid=compiled.os.getuid(): uid + 1)
    assert compiled.cache_directory() is None


@needs_compiler
def test_a_read_only_cache_is_done_without(cache, monkeypatch):
    make = compiled.tempfile.mkstemp

    def refuse(*arguments, dir=None, **options):
        if dir is not None and cache in (dir, *dir.parents):
            raise PermissionError(13, "Permission denied")
        return make(*arguments, dir=dir, **options)

    monkeypatch.setattr(compiled.tempfile, "mkstemp", refuse)
    function = compiled.compile_function(FUNCTION)
    assert is_compiled(function) and works(function)
    assert not list(cache.iterdir())


@needs_compiler
@pytest.mark.parametrize("step", ["fdopen", "replace"])
def test_a_full_disk_leaves_nothing_behind(cache, monkeypatch, step):
    monkeypatch.setattr(compiled.os, step, fail(OSError(28, "No space left on device")))
    function = compiled.compile_function(FUNCTION)
    assert is_compiled(function) and works(function)
    assert not list(cache.iterdir())


@needs_compiler
def test_a_cache_that_may_not_hold_programs_is_done_without(cache, monkeypatch):
    external = ca.external

    def refuse(name, path):
        if str(cache) in path:
            raise RuntimeError("failed to map segment from shared object: Operation not permitted")
        return external(name, path)

    monkeypatch.setattr(ca, "external", refuse)
    for _ in range(2):
        function = compiled.compile_function(FUNCTION)
        assert is_compiled(function) and works(function)


def test_no_room_for_the_source_costs_speed_only(monkeypatch):
    error = FileNotFoundError(2, "No usable temporary directory found")
    monkeypatch.setattr(compiled.tempfile, "TemporaryDirectory", fail(error))
    assert compiled.compile_function(FUNCTION) is FUNCTION


def test_nothing_is_left_in_the_temporary_folder(tmp_path, monkeypatch):
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setattr(compiled.tempfile, "tempdir", str(scratch))
    compiled.compile_function(FUNCTION)
    assert not list(scratch.iterdir())
