"""Scenes shared by the devices of two processes: the bits of one process, one file, and an error where a process is killed."""

import json
import os
import socket
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring import processes
from jaxspring.processes import gathered, is_spread, placed

NET = js.lattice((2, 3))
ROOT = Path(__file__).resolve().parents[2]
N_SCENES, N_STEPS = 8, 30
# No answer for so long is a hang. A process that was killed is noticed in less than a second on an idle machine.
PATIENCE_S = 600.0
HEARTBEAT_S = 20


def scenes():
    """Starts (B, N, D), stiffnesses (B, E), and dt (B,), one of which ends with an error."""
    rng = np.random.default_rng(4)
    dt = np.full(N_SCENES, 0.02)
    dt[6] = 1e6
    return NET.grid() + 0.1 * rng.normal(size=(N_SCENES, 6, 2)), rng.uniform(5, 20, (N_SCENES, NET.n_springs)), dt


def run(n_steps, state, k, dt, resume=None):
    """Steps of one sheet, by a stepper that remembers."""
    system = js.System(NET, 1.0, js.Springs(NET, k, 1.0))
    return js.rollout(system, state, js.VelocityVerlet(), dt, n_steps, resume=resume)


def first(points, k, dt):
    """From the start."""
    return run(N_STEPS, js.State.from_points(NET, points), k, dt)


def further(state, resume, k, dt):
    """And as long again."""
    return run(N_STEPS, state, k, dt, resume)


NET_OF_ROWS = js.lattice((8, 4))


def rows():
    """A sheet whose rows are shared out."""
    return js.State.from_points(NET_OF_ROWS, NET_OF_ROWS.grid() + 0.1 * np.random.default_rng(5).normal(size=(32, 2)))


def swing(state):
    """The sheet's rows swing."""
    return js.rollout(js.System(NET_OF_ROWS, 1.0, js.Springs(NET_OF_ROWS, 10.0, 1.0)), state, js.SymplecticEuler(), 0.02, N_STEPS)


WORKER = """
    import json, os, signal, sys, time
    import jax
    jax.config.update("jax_enable_x64", True)
    task, rank, address, folder = sys.argv[1], int(sys.argv[2]), sys.argv[3], sys.argv[4]
    jax.distributed.initialize(address, 2, rank, coordinator_bind_address=address, heartbeat_timeout_seconds={heartbeat})
    import numpy as np
    import jaxspring as js
    from jaxspring import files
    from tests.unit.test_processes import first, further, rows, scenes, swing

    if rank == 1:
        files.write_archive = None  # process 0 alone writes

    def die_in_turn(killed, tree):
        if rank == killed:
            os.kill(os.getpid(), signal.SIGKILL)
        began = time.monotonic()
        try:
            js.save(folder + "/never.npz", tree)
        except ConnectionError as error:
            print(json.dumps({{"seconds": time.monotonic() - began, "error": str(error)}}), flush=True)
            os._exit(3)

    points, k, dt = scenes()
    mesh = jax.make_mesh((jax.device_count(),), ("shared",))
    assert (jax.process_count(), jax.local_device_count()) == (2, 2 if task == "first" else 1)
    if task == "first":
        result = jax.jit(js.batch(first, mesh=mesh, chunk=2))(points, k, dt)
        assert not result.state.position.x.is_fully_addressable
        assert "in several processes" in str(result)
        try:
            js.raise_for_status(result)
        except js.SimulationError as error:
            assert "lane 6" in str(error), error
        else:
            raise SystemExit("a scene failed, and nothing was said")
        js.save(folder + "/first.npz", (result.state, result.resume))
        js.save(folder + "/rows.npz", js.domain(rows(), mesh))
        try:
            js.save(folder + "/missing/rows.npz", result.resume)
        except OSError as error:
            assert ("no folder", "process 0 could not")[rank] in str(error), error
        else:
            raise SystemExit("a file in no folder was written")
        die_in_turn(1, result.state)
    like = jax.eval_shape(js.batch(first), points, k, dt)
    state, resume = js.load(folder + "/first.npz", like=(like.state, like.resume))
    result = jax.jit(js.batch(further, mesh=mesh, chunk=2))(state, resume, k, dt)
    js.save(folder + "/further.npz", result.state)
    shared = js.load(folder + "/rows.npz", like=js.domain(rows(), mesh))
    assert shared.position.x.sharding.num_devices == 2 and not shared.position.x.is_fully_addressable
    js.save(folder + "/rows again.npz", shared)
    end = swing(shared)
    js.raise_for_status(end)
    assert "steps: OK" in str(end) and "float64[8, 4] in several processes m" in str(end)
    js.save(folder + "/swung.npz", end.state)
    die_in_turn(0, result.state)
"""


@pytest.fixture
def pair(tmp_path):
    """Start two processes that share their devices; give (exit code, stdout, stderr) of each when both have ended."""
    started = []

    def start(task, n_devices):
        # The system picks a port that is free, and no other program is given it while the socket is held.
        with socket.socket() as held:
            held.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
            held.bind(("127.0.0.1", 0))
            address = f"127.0.0.1:{held.getsockname()[1]}"
            environment = {name: value for name, value in os.environ.items() if not name.lower().endswith("_proxy")}
            flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={n_devices}"
            environment |= {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
            program = textwrap.dedent(WORKER.format(heartbeat=HEARTBEAT_S))
            for rank in (0, 1):
                command = [sys.executable, "-c", program, task, str(rank), address, str(tmp_path)]
                started.append(
                    subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment, cwd=ROOT)
                )
            end = time.monotonic() + PATIENCE_S
            said = [process.communicate(timeout=max(end - time.monotonic(), 1.0)) for process in started[-2:]]
        return [(process.returncode, *words) for process, words in zip(started[-2:], said, strict=True)]

    yield start
    for process in started:
        process.kill()
        process.communicate()


@pytest.mark.slow
def test_two_processes_compute_what_one_does(pair, tmp_path):
    """Over four devices of two processes every bit is that of one process; the state is written once, and read on one device and on two.
    A killed worker is an error in the other; two new processes go on from the file, bit for bit as one does. They also share the rows of
    a sheet, to rounding as one device has it. Where the first process is killed, the other ends as well.
    """
    (code, said, trouble), (killed, _, _) = pair("first", 2)
    assert killed == -9, trouble
    assert code == 3, trouble[-3000:]
    told = json.loads(said.splitlines()[-1])
    assert told["seconds"] < 2 * HEARTBEAT_S
    assert "another process has ended" in told["error"]

    points, k, dt = scenes()
    whole = jax.jit(js.batch(first, chunk=2))(points, k, dt)
    js.save(tmp_path / "by one.npz", (whole.state, whole.resume))
    assert (tmp_path / "by one.npz").read_bytes() == (tmp_path / "first.npz").read_bytes()
    js.save(tmp_path / "rows by one.npz", rows())
    assert (tmp_path / "rows by one.npz").read_bytes() == (tmp_path / "rows.npz").read_bytes()
    state, _ = js.load(tmp_path / "first.npz", like=(whole.state, whole.resume))
    np.testing.assert_array_equal(state.points, whole.state.points)

    (killed, _, trouble), (code, said, other) = pair("further", 1)
    assert killed == -9, trouble[-3000:]
    # Either the error of `save`, or JAX ends the process, which has lost the one that it reports to.
    assert code == 3 or "another task died" in other, other[-3000:]
    js.save(tmp_path / "further by one.npz", jax.jit(js.batch(further, chunk=2))(whole.state, whole.resume, k, dt).state)
    assert (tmp_path / "further.npz").read_bytes() == (tmp_path / "further by one.npz").read_bytes()
    assert (tmp_path / "rows again.npz").read_bytes() == (tmp_path / "rows.npz").read_bytes()
    by_one = swing(rows())
    np.testing.assert_allclose(js.load(tmp_path / "swung.npz", like=by_one.state).points, by_one.state.points, rtol=0, atol=1e-12)
    assert not (tmp_path / "never.npz").exists()


def test_one_process_holds_all_that_it_has():
    """Nothing is spread where there is one process; what is gathered is what was given, and what is placed lies as told."""
    tree = {"a": jnp.arange(3.0), "b": 1.0, "c": None, "d": len}
    assert not is_spread(tree)
    assert gathered(tree)["a"] is tree["a"]
    put = jax.device_put(tree["a"], jax.devices()[0])
    for sharding, is_bound in ((None, False), (put.sharding, True)):
        found = placed(np.arange(3.0), sharding)
        assert found.committed == is_bound
        np.testing.assert_array_equal(found, tree["a"])


def test_of_several_processes_one_writes(monkeypatch, tmp_path):
    """Process 0 writes a file or the checkpoint of a fit, and raises what kept it from that; the others write nothing, and hear of it."""
    monkeypatch.setattr(processes, "is_spread", lambda _: True)
    monkeypatch.setattr(processes, "_together", lambda a: np.asarray(a)[None])
    place = js.Checkpoint(tmp_path / "fit.npz", every=1)
    for rank, is_there in ((1, False), (0, True)):
        monkeypatch.setattr(jax, "process_index", lambda rank=rank: rank)
        js.save(tmp_path / "a.npz", {"a": np.arange(3)})
        js.fit(lambda k: (k - 1.0) ** 2, 2.0, js.Adam(0.1), 2, checkpoint=place)
        assert (tmp_path / "a.npz").exists() == place.path.exists() == is_there

    def fail(_):
        raise FileNotFoundError("there is no such folder")

    with pytest.raises(FileNotFoundError, match="no such folder"):
        processes.write_by_one("a.npz", {}, fail)
    monkeypatch.setattr(processes, "_together", lambda a: np.array([True, False]))
    monkeypatch.setattr(jax, "process_index", lambda: 1)
    with pytest.raises(OSError, match=r"a\.npz was not written: process 0 could not, and says why"):
        processes.write_by_one("a.npz", {}, fail)
