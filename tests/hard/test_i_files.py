"""Hard cases I, files: damage is found, nothing is trusted, and a kill at any moment loses at most the last write."""

import hashlib
import io
import json
import os
import pickle
import resource
import signal
import struct
import subprocess
import sys
import time
import tracemalloc
import zipfile

import jax.numpy as jnp
import numpy as np
import pytest

from jaxspring.archive import CheckpointError, read_archive, write_archive
from jaxspring.files import load, save
from tests import source


def tree(seed):
    """Arrays of several types, 3 kB in all."""
    rng = np.random.default_rng(seed)
    return {"a": rng.normal(size=(7, 11)), "b": rng.integers(0, 100, 40), "c": {"d": rng.random(60) < 0.5, "e": rng.normal(size=300)}}


def outcome(path, data, allowed):
    """`equal` or `refused` for these bytes; anything else fails."""
    path.write_bytes(data)
    try:
        found = read_archive(path).arrays
    except CheckpointError:
        return "refused"
    assert any(set(found) == set(one) and all(np.array_equal(found[n], one[n]) for n in found) for one in allowed), "wrong numbers"
    return "equal"


@pytest.fixture(scope="module")
def originals(tmp_path_factory):
    """Bytes and arrays of two files of one structure."""
    folder = tmp_path_factory.mktemp("originals")
    found = []
    for seed in (1, 2):
        save(folder / f"{seed}.npz", tree(seed))
        found.append(((folder / f"{seed}.npz").read_bytes(), read_archive(folder / f"{seed}.npz").arrays))
    return found


def test_i1_truncated_files_are_refused(originals, tmp_path, rng):
    """I1: cut at 200 lengths, every file is refused."""
    data, arrays = originals[0]
    lengths = rng.integers(0, len(data), 200)
    assert {outcome(tmp_path / "x", data[:n], [arrays]) for n in lengths} == {"refused"}


@pytest.mark.slow
def test_i1_flipped_bits_never_give_wrong_numbers(originals, tmp_path, rng):
    """I1: 3,000 single flipped bits; each file is refused or gives the very same numbers."""
    data, arrays = originals[0]
    results = []
    for bit in rng.integers(0, 8 * len(data), 3000):
        damaged = bytearray(data)
        damaged[bit // 8] ^= 1 << (bit % 8)
        results.append(outcome(tmp_path / "x", bytes(damaged), [arrays]))
    assert results.count("refused") > 2000  # the rest hit bytes that mean nothing, such as time stamps


@pytest.mark.slow
def test_i1_header_bytes_never_give_wrong_numbers(originals, tmp_path, rng):
    """I1: 3,000 random bytes in the JSON header and the zip directory."""
    data, arrays = originals[0]
    start = data.index(b'{"format"')
    for position, value in zip(rng.integers(start, len(data), 3000), rng.integers(0, 256, 3000), strict=True):
        damaged = bytearray(data)
        damaged[position] = value
        outcome(tmp_path / "x", bytes(damaged), [arrays])


def test_i1_spliced_files_never_give_wrong_numbers(originals, tmp_path, rng):
    """I1: 500 files whose front is from one and whose rest is from another of the same structure."""
    (one, first), (two, second) = originals
    assert len(one) == len(two)
    results = [outcome(tmp_path / "x", one[:n] + two[n:], [first, second]) for n in rng.integers(1, len(one) - 1, 500)]
    assert results.count("refused") > 470


def test_i1_a_member_of_another_file_is_refused(originals, tmp_path):
    """I1: an array taken whole, with a right checksum of its own, from another file."""
    (one, _), (two, _) = originals
    with zipfile.ZipFile(io.BytesIO(one)) as a, zipfile.ZipFile(io.BytesIO(two)) as b, zipfile.ZipFile(tmp_path / "x", "w") as mixed:
        for name in a.namelist():
            mixed.writestr(name, (b if name == "a.npy" else a).read(name))
        mixed.comment = a.comment
    with pytest.raises(CheckpointError, match=r"x: the digest of 'a' does not match"):
        read_archive(tmp_path / "x")


class Bomb:
    """Pickled, it would run a command."""

    def __reduce__(self):
        return os.mkdir, ("payload_ran",)


def test_i2_pickles_are_refused_and_not_run(tmp_path, monkeypatch):
    """I2: an object array with a payload, as NumPy would pickle it; and one that the header calls numbers."""
    monkeypatch.chdir(tmp_path)
    np.savez("bomb.npz", a=np.array([Bomb()], dtype=object))
    (tmp_path / "plain").write_bytes(pickle.dumps(Bomb()))
    for name in ("bomb.npz", "plain"):
        with pytest.raises(CheckpointError):
            load(name)
    buffer = io.BytesIO()
    np.save(buffer, np.array([Bomb()], dtype=object), allow_pickle=True)
    forge("forged", {"a": ("|O", [1], buffer.getvalue())})
    with pytest.raises(CheckpointError, match="claims dtype object"):
        load("forged")
    assert not os.path.exists("payload_ran")


def forge(path, members, version=1, method=zipfile.ZIP_STORED, header_padding=0):
    """A file with a header that agrees with itself: {name: (dtype, shape, bytes)}."""
    entries = [
        {"name": name, "dtype": dtype, "shape": shape, "fortran": False, "sha256": hashlib.sha256(data).hexdigest()}
        for name, (dtype, shape, data) in members.items()
    ]
    header = json.dumps({"format": "jaxspring", "version": version, "about": {}, "arrays": entries}).encode() + b" " * header_padding
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, (_, _, data) in members.items():
            archive.writestr(f"{name}.npy", data)
        archive.writestr("header.json", header)
        archive.comment = b"jaxspring sha256 " + hashlib.sha256(header).hexdigest().encode()


def npy(array):
    """The bytes of an `.npy` file."""
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("members", "arguments", "words"),
    [
        ({"a": ("|u1", [1 << 30], npy(np.zeros(1 << 26, np.uint8)))}, {"method": zipfile.ZIP_DEFLATED}, "compressed"),
        ({"a": ("<f8", [10**13], npy(np.zeros(8)))}, {}, "claims shape"),
        ({"a": ("<f8", [2**62, 2**62], npy(np.zeros(8)))}, {}, "claims shape"),
        ({"a": ("<f8", [-8], npy(np.zeros(8)))}, {}, "claims dtype"),
        ({"../../x": ("<f8", [8], npy(np.zeros(8)))}, {}, "is not a name"),
        ({"/etc/x": ("<f8", [8], npy(np.zeros(8)))}, {}, "is not a name"),
        ({}, {"header_padding": 1 << 25}, "its header has"),
    ],
    ids=["compressed", "80 TB", "overflow", "negative", "dots", "absolute", "header"],
)
def test_i3_absurd_files_are_refused_before_memory_is_taken(members, arguments, words, tmp_path):
    """I3: what claims too much, or a path, is refused while less than 4 MiB were allocated."""
    path = tmp_path / "x"
    forge(path, members, **arguments)
    refused_in_little_memory(path, words)


def test_i3_a_directory_that_claims_more_than_the_file(tmp_path):
    """I3: header and zip directory that agree on 1 GiB in a file of a few hundred bytes are refused in less than 4 MiB, too."""
    path = tmp_path / "x"
    small = npy(np.zeros(8, np.uint8))
    forge(path, {"a": ("|u1", [1 << 30], small)})
    data = bytearray(path.read_bytes())
    directory, claimed = data.index(b"PK\1\2"), len(small) - 8 + (1 << 30)
    data[directory + 20 : directory + 28] = struct.pack("<II", claimed, claimed)  # both sizes of its first entry
    path.write_bytes(data)
    refused_in_little_memory(path, "claim more than")


def refused_in_little_memory(path, words):
    """A CheckpointError that says so, before 4 MiB were allocated."""
    tracemalloc.start()
    try:
        with pytest.raises(CheckpointError, match=words):
            read_archive(path)
        assert tracemalloc.get_traced_memory()[1] < 4 << 20
    finally:
        tracemalloc.stop()


WRITER = """
import sys, itertools, numpy as np
from jaxspring.archive import write_archive
for i in itertools.count():
    write_archive(sys.argv[1], {"i": np.array(i), "data": np.full(400_000, float(i))})
    print(i, flush=True)
"""


@pytest.mark.slow
def test_i4_a_kill_at_any_moment_leaves_the_newest_complete_file(tmp_path, rng):
    """I4: after each of 25 SIGKILLs the file is whole, and not older than the last write that had returned."""
    path = tmp_path / "x.npz"
    for _ in range(25):
        writer = subprocess.Popen([sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, cwd=source.ROOT)
        newest = int(writer.stdout.readline())
        time.sleep(rng.uniform(0, 0.05))
        writer.send_signal(signal.SIGKILL)
        newest = max([newest, *map(int, writer.stdout.read().split(b"\n")[:-1])])
        assert writer.wait() == -signal.SIGKILL
        arrays = read_archive(path).arrays
        assert newest <= int(arrays["i"]) <= newest + 1
        assert np.all(arrays["data"] == arrays["i"])
        writer.stdout.close()


FIT = """
import sys, time, jax.numpy as jnp
from jaxspring.inverse.checkpoint import Checkpoint
from jaxspring.inverse.fit import fit
def loss(p): return jnp.sum((p ** 2 - jnp.arange(5.0)) ** 2)
def slowly(it):
    print(it.index, flush=True); time.sleep(float(sys.argv[3]))
result = fit(loss, jnp.ones(5), n_iterations=40, checkpoint=Checkpoint(sys.argv[1], every=1), resume=sys.argv[2] == "resume",
             on_iteration=slowly)
print(result.history.loss.tobytes().hex(), bytes(memoryview(result.last)).hex())
"""


def start_fit(path, how, pause):
    """A fit in a process of its own."""
    return subprocess.Popen([sys.executable, "-c", FIT, str(path), how, str(pause)], stdout=subprocess.PIPE, cwd=source.ROOT, text=True)


@pytest.mark.slow
def test_i4_a_killed_fit_resumes_bitwise(tmp_path):
    """I4: a fit killed twice and resumed ends with the bits of one that ran through."""
    path = tmp_path / "fit.npz"
    for how, after in (("start", 7), ("resume", 20)):
        process = start_fit(path, how, 0.02)
        for line in process.stdout:
            if int(line) >= after:
                break
        process.kill()
        process.wait()
        process.stdout.close()
    resumed = start_fit(path, "resume", 0).communicate()[0].splitlines()
    unbroken = start_fit(tmp_path / "other.npz", "start", 0).communicate()[0].splitlines()
    assert len(unbroken) == 42
    assert len(resumed) < 25
    assert resumed[-1] == unbroken[-1]


def test_i4_a_full_disk_leaves_the_old_file(tmp_path):
    """I4: where the system refuses to write more, the error comes through, and the old file is still there, alone."""
    path = tmp_path / "x.npz"
    write_archive(path, {"a": np.arange(3)})
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    old_handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 16, before[1]))
    try:
        with pytest.raises(OSError, match="File too large"):
            write_archive(path, {"a": np.zeros(1 << 20)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, old_handler)
    np.testing.assert_array_equal(read_archive(path).arrays["a"], np.arange(3))
    assert os.listdir(tmp_path) == ["x.npz"]


def test_i7_another_version_is_named(tmp_path):
    """I7: a file of version 2 says so, and what this library reads."""
    forge(tmp_path / "x", {"a": ("<f8", [8], npy(np.zeros(8)))}, version=2)
    with pytest.raises(CheckpointError, match=r"x: it is of format version 2; this library reads version 1"):
        read_archive(tmp_path / "x")
    forge(tmp_path / "x", {"a": ("<f8", [8], npy(np.arange(8.0)))})
    np.testing.assert_array_equal(read_archive(tmp_path / "x").arrays["a"], np.arange(8.0))  # the forgery is otherwise sound


@pytest.mark.parametrize(
    ("like", "words"), [(jnp.zeros(8), "shape (9,) and dtype float64; expected shape (8,)"), (jnp.zeros(9, jnp.float32), "float32")]
)
def test_i7_another_node_count_or_dtype_is_named(like, words, tmp_path):
    """I7: both sides are named."""
    save(tmp_path / "x.npz", {"position": jnp.zeros(9)})
    with pytest.raises(CheckpointError) as caught:
        load(tmp_path / "x.npz", like={"position": like})
    assert "'position' has shape (9,) and dtype float64" in str(caught.value)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    "array",
    [
        np.array(3.5),
        np.zeros((0, 3)),
        np.asfortranarray(np.arange(12.0).reshape(3, 4)),
        np.arange(5, dtype=">f8"),
        np.array(7, dtype=">i2"),
        np.array([True, False]),
        np.arange(24).reshape(2, 3, 4)[:, ::2, ::-1],
        np.array([np.nan, -0.0, np.inf, 5e-324]),
        np.array([1 + 2j], np.complex64),
        np.uint64(2**64 - 1),
    ],
    ids=["0-d", "empty", "fortran", "big-endian", "0-d big-endian", "bool", "strided", "special", "complex", "uint64"],
)
def test_i8_exact_round_trip(array, tmp_path):
    """I8: bits, shape, dtype with its byte order, and memory order."""
    array = np.asarray(array)
    save(tmp_path / "x.npz", {"a": array})
    for back in (load(tmp_path / "x.npz")["a"], load(tmp_path / "x.npz", like={"a": array})["a"]):
        assert back.dtype == array.dtype
        assert back.dtype.byteorder == array.dtype.byteorder
        assert back.shape == array.shape
        assert back.tobytes() == array.tobytes()
        assert back.flags.f_contiguous or not array.flags.f_contiguous
        assert back.flags.writeable
