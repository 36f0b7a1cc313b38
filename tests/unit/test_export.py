"""Files for viewers: every number comes back through a reader that is not the library's, and what cannot be written is refused by name."""

import base64
import dataclasses
import os
import re
import types
import xml.etree.ElementTree as ET

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import jaxspring as js
from jaxspring.export import places, ply, vtk

SHEET = js.lattice((3, 4), js.STRUCTURAL + js.SHEAR)
# A graph whose own order of nodes is not the user's.
RING = js.Graph.from_edges([[4, 0], [0, 3], [3, 1], [1, 2], [2, 4]], 5)
DUST = js.Graph.from_edges(np.zeros((0, 2), int), 1)
VTK_TYPES = {"Float32": "<f4", "Float64": "<f8", "Int32": "<i4", "Int64": "<i8", "UInt8": "u1"}


def random_state(net, dim, rng, dtype=np.float64, temperature=None):
    """Positions and velocities without any pattern."""
    points, velocities = (rng.normal(size=(net.n_nodes, dim)).astype(dtype) for _ in range(2))
    return js.State.from_points(net, points, velocities, time=dtype(0.1), temperature=temperature)


def stacked(*states):
    """States on a leading axis, one second apart where they are of one time."""
    if len({np.asarray(state.time).tobytes() for state in states}) == 1 and np.ndim(states[0].time) == 0:
        states = [dataclasses.replace(state, time=state.time + i) for i, state in enumerate(states)]
    return jax.tree.map(lambda *a: jnp.stack(a), *states)


def broken(net, state, which):
    """The state with these springs broken."""
    alive = np.ones(net.n_springs, bool)
    alive[which] = False
    return dataclasses.replace(state, alive=net.own(net.split(jnp.asarray(alive)).families))


def read_vtu(path):
    """Points, cells as lists of nodes, and the arrays of points, cells and the grid, by name; as VTK's description of the format says."""
    root = ET.parse(path).getroot()
    assert root.attrib == {"type": "UnstructuredGrid", "version": "1.0", "byte_order": "LittleEndian", "header_type": "UInt64"}
    piece = root.find("UnstructuredGrid/Piece")

    def arrays(element):
        found = {}
        for one in element:
            if one.get("format") == "ascii":
                found[one.get("Name")] = np.array(one.text.split(), float)
                continue
            data = base64.b64decode(one.text, validate=True)
            n_bytes = int.from_bytes(data[:8], "little")
            assert len(data) == 8 + n_bytes
            array = np.frombuffer(data, VTK_TYPES[one.get("type")], offset=8)
            found[one.get("Name")] = array.reshape(-1, int(one.get("NumberOfComponents"))) if one.get("NumberOfComponents") else array
        return found

    cells = arrays(piece.find("Cells"))
    corners = np.split(cells["connectivity"], cells["offsets"][:-1])
    points = arrays(piece.find("Points"))["Points"]
    assert (int(piece.get("NumberOfPoints")), int(piece.get("NumberOfCells"))) == (len(points), len(cells["types"]))
    return {
        "points": points,
        "cells": [nodes.tolist() for nodes in corners] if len(cells["types"]) else [],
        "types": cells["types"].tolist(),
        "nodes": arrays(piece.find("PointData")),
        "of_cells": arrays(piece.find("CellData")),
        "time": float(arrays(root.find("UnstructuredGrid/FieldData"))["TimeValue"][0]),
    }


def read_xyz(path):
    """A list of frames: the words of the second line by name, and the columns by name."""
    lines, frames = path.read_text().splitlines(), []
    while lines:
        n = int(lines[0])
        about = {key: quoted or plain for key, quoted, plain in re.findall(r'(\w+)=(?:"([^"]*)"|(\S+))', lines[1])}
        rows, at, columns = [line.split() for line in lines[2 : 2 + n]], 0, {}
        parts = about.pop("Properties").split(":")
        for name, kind, width in zip(parts[::3], parts[1::3], map(int, parts[2::3]), strict=True):
            columns[name] = np.array([row[at : at + width] for row in rows], {"S": str, "R": np.float64, "I": np.int64}[kind])
            at += width
        assert all(len(row) == at for row in rows)
        frames.append((about, columns))
        lines = lines[2 + n :]
    return frames


# VTK


@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("net", [SHEET, RING], ids=["lattice", "graph"])
def test_vtk_brings_every_number_back(net, dim, dtype, rng, tmp_path):
    """Coordinates, velocity, temperature and fields of one state: the same bits, in the user's order, z = 0 where there is none."""
    n = net.n_nodes
    state = random_state(net, dim, rng, dtype.type, temperature=np.arange(n) + dtype.type(300))
    load, tension, kind = rng.normal(size=(n, dim)).astype(dtype), rng.normal(size=net.n_springs).astype(dtype), np.arange(n) % 3
    js.save_vtk(
        tmp_path / "a.vtu", state, net, {"load": load, "kind": kind}, {"tension": tension, "odd": np.arange(net.n_springs) % 2 == 1}
    )
    found = read_vtu(tmp_path / "a.vtu")
    for name, given in (("velocity", state.velocities), ("load", load)):
        np.testing.assert_array_equal(found["nodes"][name], np.pad(given, ((0, 0), (0, 3 - dim))))
    np.testing.assert_array_equal(found["points"], np.pad(state.points, ((0, 0), (0, 3 - dim))))
    assert found["points"].dtype == found["nodes"]["velocity"].dtype == found["of_cells"]["tension"].dtype == dtype
    np.testing.assert_array_equal(found["nodes"]["temperature"], np.arange(n) + 300)
    np.testing.assert_array_equal(found["nodes"]["kind"], kind)
    np.testing.assert_array_equal(found["of_cells"]["tension"], tension)
    np.testing.assert_array_equal(found["of_cells"]["odd"], np.arange(net.n_springs) % 2)
    assert (found["cells"], set(found["types"])) == (net.edges.tolist(), {3})
    assert found["time"] == pytest.approx(0.1, rel=1e-7)
    assert set(found["of_cells"]) == {"tension", "odd"}  # springs that cannot break, in no box, say nothing of it


def test_vtk_writes_the_bytes_of_vtk(tmp_path):
    """The arrays stand as VTK 9.7.2 itself wrote those of the same grid."""
    net = js.Graph.from_edges([[0, 1]], 2)
    js.save_vtk(tmp_path / "a.vtu", js.State.from_points(net, [[1.0, 0.0, 0.0], [0.0, 2.5, -3.0]]), net)
    text = (tmp_path / "a.vtu").read_text()
    assert ">MAAAAAAAAAAAAAAAAADwPwAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAARAAAAAAAAACMA=<" in text
    assert all(f">{data}<" in text for data in ("EAAAAAAAAAAAAAAAAAAAAAEAAAAAAAAA", "CAAAAAAAAAACAAAAAAAAAA==", "AQAAAAAAAAAD"))


def test_a_run_becomes_a_folder_with_a_list(rng, tmp_path):
    """The collection names every file with its time, and each holds its frame and that frame's fields."""
    springs = js.Springs(SHEET, 30.0, 0.9)
    saved = stacked(*(dataclasses.replace(random_state(SHEET, 2, rng), time=jnp.asarray(0.1 * i)) for i in range(3)))
    run = types.SimpleNamespace(saved=saved)  # as a result has it
    tension = jax.jit(jax.vmap(springs.tension))(saved)
    height = np.asarray(saved.points)[..., 1]
    tails, heads = (np.asarray(saved.points)[:, ends] for ends in SHEET.edges.T)
    length = np.linalg.norm(heads - tails, axis=-1)
    js.save_vtk(tmp_path / "fall", run, SHEET, {"height": height}, {"tension": tension, "length": length, "number": np.arange(29)})
    names = [f"fall_000{i}.vtu" for i in range(3)]
    assert sorted(os.listdir(tmp_path / "fall")) == ["fall.pvd", *names]
    listed = ET.parse(tmp_path / "fall" / "fall.pvd").getroot().findall("Collection/DataSet")
    assert [one.get("file") for one in listed] == names
    assert [float(one.get("timestep")) for one in listed] == run.saved.time.tolist()
    for i, name in enumerate(names):
        found = read_vtu(tmp_path / "fall" / name)
        np.testing.assert_array_equal(found["points"][:, :2], run.saved.points[i])
        np.testing.assert_array_equal(found["nodes"]["height"], height[i])
        np.testing.assert_array_equal(found["of_cells"]["length"], length[i])
        np.testing.assert_allclose(found["of_cells"]["tension"], 30.0 * (length[i] - 0.9), rtol=1e-9)
        np.testing.assert_array_equal(found["of_cells"]["number"], np.arange(29))
        assert found["time"] == float(run.saved.time[i])


def test_states_with_an_axis_are_written_as_a_run(rng, tmp_path):
    """A State with a leading axis of frames needs no result around it; an axis of one frame is a run too."""
    states = stacked(random_state(RING, 2, rng), random_state(RING, 2, rng))
    js.save_vtk(tmp_path / "two", states, RING)
    np.testing.assert_array_equal(read_vtu(tmp_path / "two" / "two_0001.vtu")["points"][:, :2], states.points[1])
    js.save_vtk(tmp_path / "one", jax.tree.map(lambda a: a[:1], states), RING)
    assert sorted(os.listdir(tmp_path / "one")) == ["one.pvd", "one_0000.vtu"]


def test_broken_springs_are_marked_and_loose_nodes_are_cells(rng, tmp_path):
    """Springs stay in their places with alive = 0; a node that no whole spring holds becomes a vertex, where fields of springs are NaN."""
    whole = random_state(RING, 2, rng)
    states = stacked(broken(RING, whole, []), broken(RING, whole, [0, 1]))  # both springs of node 0
    js.save_vtk(tmp_path / "melt", states, RING, None, {"k": np.arange(5.0), "number": np.arange(5)}, triangles=[[0, 1, 2]])
    first, second = (read_vtu(tmp_path / "melt" / f"melt_000{i}.vtu") for i in range(2))
    assert (first["cells"], first["types"]) == ([*RING.edges.tolist(), [0, 1, 2]], [3] * 5 + [5])
    assert (second["cells"], second["types"]) == ([*RING.edges.tolist(), [0], [0, 1, 2]], [3] * 5 + [1, 5])
    assert first["of_cells"]["alive"].tolist() == [1] * 6
    assert second["of_cells"]["alive"].tolist() == [0, 0, 1, 1, 1, 1, 1]
    np.testing.assert_array_equal(second["of_cells"]["k"], [0, 1, 2, 3, 4, np.nan, np.nan])
    assert second["of_cells"]["number"].tolist() == [0, 1, 2, 3, 4, 0, 0]
    # What breaks in another net is not this one's.
    js.save_vtk(tmp_path / "a.vtu", broken(RING, whole, [0, 1]), RING.named("other"))
    assert read_vtu(tmp_path / "a.vtu")["of_cells"] == {}


def test_springs_through_the_side_of_a_box_are_marked(tmp_path):
    """`wraps` is 1 for the springs whose ends are drawn farther apart than half a period, and for no other."""
    net = js.lattice((4, 6), periodic=(False, True), box=(9.0, 0.0))
    points = net.grid()
    js.save_vtk(tmp_path / "a.vtu", js.State.from_points(net, points), net)
    expected = np.abs(points[net.edges[:, 0]] - points[net.edges[:, 1]])[:, 0] > 4.5
    assert expected.sum() == 4
    np.testing.assert_array_equal(read_vtu(tmp_path / "a.vtu")["of_cells"]["wraps"], expected)


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_one_node_without_springs(dim, tmp_path):
    """A single particle is a point that every format shows."""
    state = js.State.from_points(DUST, np.full((1, dim), 2.0))
    js.save_vtk(tmp_path / "a.vtu", state, DUST, {"mass": [3.0]}, {"tension": np.zeros(0)})
    found = read_vtu(tmp_path / "a.vtu")
    assert (found["cells"], found["types"], found["points"].tolist()) == ([[0]], [1], [[2.0] * dim + [0.0] * (3 - dim)])
    assert np.isnan(found["of_cells"]["tension"]).tolist() == [True]
    js.save_xyz(tmp_path / "a.xyz", state, DUST)
    assert read_xyz(tmp_path / "a.xyz")[0][1]["pos"].tolist() == found["points"].tolist()
    js.save_ply(tmp_path / "a.ply", state, DUST)
    assert np.asarray(trimesh.load(tmp_path / "a.ply").vertices).tolist() == found["points"].tolist()


# XYZ


def test_xyz_brings_every_number_back(dtype, rng, tmp_path):
    """All frames in one file; text that gives back the very same float32 and float64, however small or large."""
    states = [random_state(RING, 2, rng, dtype.type, temperature=dtype.type(300)) for _ in range(3)]
    size = np.array([1e-30, 1e-7, 1.0, 1e7, 1e30], dtype)[:, None]
    states[0] = js.State.from_points(RING, states[0].points * size, time=dtype.type(0.1), temperature=dtype.type(300))
    frames = stacked(*states)
    push = rng.normal(size=(3, 5, 2)).astype(dtype)
    js.save_xyz(tmp_path / "a.xyz", frames, RING, {"push": push, "kind": np.arange(5), "held": np.arange(5) < 2})
    read = read_xyz(tmp_path / "a.xyz")
    assert len(read) == 3
    for i, (about, columns) in enumerate(read):
        assert list(columns) == ["species", "pos", "velo", "temperature", "push", "kind", "held"]
        for name, given in (("pos", frames.points), ("velo", frames.velocities), ("push", push)):
            np.testing.assert_array_equal(columns[name].astype(dtype), np.pad(given[i], ((0, 0), (0, 1))))
        assert columns["kind"].ravel().tolist() == [0, 1, 2, 3, 4]
        assert columns["held"].ravel().tolist() == [1, 1, 0, 0, 0]
        assert (columns["temperature"] == 300).all()
        assert set(columns["species"].ravel()) == {"X"}
        assert (dtype.type(about["Time"]), about["pbc"]) == (dtype.type(frames.time[i]), "F F F")
        assert "Lattice" not in about


def test_xyz_tells_the_box(tmp_path):
    """A periodic box stands in every frame; a side that does not repeat reaches from the lowest node to the highest."""
    net = js.lattice((4, 6), periodic=(False, True), box=(9.0, 0.0))
    js.save_xyz(tmp_path / "a.xyz", js.State.from_points(net, net.grid() + 1.0), net)
    about, _ = read_xyz(tmp_path / "a.xyz")[0]
    assert about["pbc"] == "T F F"
    np.testing.assert_allclose(np.array(about["Lattice"].split(), float).reshape(3, 3), np.diag([9.0, 3.0, 1.0]))
    assert about["Origin"].split() == ["0", "1", "0"]


# PLY


def test_ply_is_read_by_trimesh(dtype, rng, tmp_path):
    """Vertices, faces and edges, of which only whole springs are written."""
    state = broken(SHEET, random_state(SHEET, 2, rng, dtype.type), [1, 5])
    triangles = [[0, 1, 4], [1, 5, 4]]
    js.save_ply(tmp_path / "a.ply", state, SHEET, {"mass": np.arange(12)}, triangles)
    mesh = trimesh.load(tmp_path / "a.ply", process=False)
    raw = mesh.metadata["_ply_raw"]
    np.testing.assert_array_equal(np.asarray(mesh.vertices, dtype), np.pad(state.points, ((0, 0), (0, 1))))
    assert np.asarray(mesh.faces).tolist() == triangles
    columns = raw["vertex"]["data"]
    assert columns["x"].dtype == dtype
    np.testing.assert_array_equal(np.stack([columns[f"velocity_{axis}"] for axis in "xy"], axis=-1), state.velocities)
    assert columns["mass"].tolist() == list(range(12))
    edges = np.stack([raw["edge"]["data"][name] for name in ("vertex1", "vertex2")], axis=-1)
    np.testing.assert_array_equal(edges, np.delete(SHEET.edges, [1, 5], axis=0))


def test_ply_of_springs_alone_and_of_a_run(rng, tmp_path):
    """A net without triangles has an element of no faces, which VTK's reader wants; a run is a folder of numbered files."""
    state = random_state(RING, 3, rng)
    js.save_ply(tmp_path / "run", stacked(state, state), RING)
    assert sorted(os.listdir(tmp_path / "run")) == ["run_0000.ply", "run_0001.ply"]
    data = (tmp_path / "run" / "run_0001.ply").read_bytes()
    assert b"element face 0\nproperty list uchar int vertex_indices\nelement edge 5\n" in data
    net, points = js.from_mesh(tmp_path / "run" / "run_0001.ply")
    np.testing.assert_array_equal(points, state.points)
    assert {frozenset(e) for e in net.edges.tolist()} == {frozenset(e) for e in RING.edges.tolist()}


# What is refused, and where files go


def frames(n=2):
    """A short run of the ring."""
    state = js.State.from_points(RING, np.arange(10.0).reshape(5, 2))
    return stacked(*[state] * n)


ONE = js.State.from_points(RING, np.arange(10.0).reshape(5, 2))
NAN = js.State(ONE.time, ONE.position.map(lambda a: a.at[2].set(jnp.nan)), ONE.velocity, ONE.layout)


@pytest.mark.parametrize(
    ("states", "options", "error", "words"),
    [
        (SHEET, {}, TypeError, "states is a Lattice; expected a State"),
        (js.State.from_points(SHEET, SHEET.grid()), {}, ValueError, r"arrays have shape \(3, 4\), the net's nodes \(5,\)"),
        (stacked(frames(), frames()), {}, ValueError, "Of a batch of runs take one"),
        (frames(2).moved(*(jax.tree.map(lambda a: a[:0], v) for v in (frames().position, frames().velocity))), {}, ValueError, "0 frames"),
        (jax.tree.map(lambda a: jnp.stack([a, a]), ONE), {}, ValueError, r"all 2 frames are of the time 0\.0 s.*Of a batch write one each"),
        (ONE, {"node_fields": {"a": SHEET.vector_field(SHEET.grid())}}, ValueError, r"node_fields\['a'\] is a Vector of .*\(3, 4\)"),
        (NAN, {}, ValueError, r"points\[\d, 0\] = nan.*raise_for_status"),
        (ONE, {"node_fields": {"a": np.ones(4)}}, ValueError, r"node_fields\['a'\] has shape \(4,\); expected \(5,\)"),
        (ONE, {"node_fields": {"a": np.ones((2, 5))}}, ValueError, r"node_fields\['a'\] has shape \(2, 5\)"),
        (frames(), {"node_fields": {"a": np.ones((3, 5))}}, ValueError, r"expected \(5,\) \(one per node\), or \(2, 5\)"),
        (ONE, {"spring_fields": {"a": np.ones((5, 1))}}, ValueError, r"spring_fields\['a'\] has shape \(5, 1\)"),
        (ONE, {"spring_fields": {"a": [1.0, 2.0, np.inf, 0.0, 0.0]}}, ValueError, r"spring_fields\['a'\]\[2\] = inf"),
        (ONE, {"spring_fields": {"a": SHEET.edge_field(np.ones(29))}}, ValueError, r"spring_fields\['a'\] is an edge field"),
        (ONE, {"node_fields": {"a": np.ones(5) + 1j}}, TypeError, r"node_fields\['a'\] has dtype complex"),
        (ONE, {"node_fields": {"a": ["x"] * 5}}, TypeError, r"node_fields\['a'\] has dtype <U1"),
        (ONE, {"node_fields": {"a": np.ma.masked_array(np.ones(5), [1, 0, 0, 0, 0])}}, ValueError, r"node_fields\['a'\]\[0\] is masked"),
        (ONE, {"node_fields": {"a": np.full(5, 2**40)}}, ValueError, r"node_fields\['a'\] holds whole numbers beyond 32 bits"),
        (ONE, {"node_fields": [1.0] * 5}, TypeError, "node_fields is a list; expected names and arrays"),
        # Readers of extended XYZ end a name at a colon, those of PLY at a blank (metatensor/metatrain issue 1185).
        (ONE, {"node_fields": {"mtt::energy": np.ones(5)}}, ValueError, "node_fields has the name 'mtt::energy'"),
        (ONE, {"spring_fields": {"tension (N)": np.ones(5)}}, ValueError, r"spring_fields has the name 'tension \(N\)'"),
        (ONE, {"node_fields": {"température": np.ones(5)}}, ValueError, "node_fields has the name 'température'"),
        (ONE, {"node_fields": {"velocity": np.ones(5)}}, ValueError, "node_fields has the name 'velocity', which the file"),
        (ONE, {"triangles": [[0, 1, 5]]}, ValueError, r"triangles\[0\].*names node 5"),
    ],
)
def test_what_cannot_be_written_is_refused_by_name(states, options, error, words, tmp_path):
    """The message names the argument, and not even an empty file is left."""
    name = "run" if isinstance(states, js.State) and states.position[0].ndim > 1 else "a.vtu"
    with pytest.raises(error, match=words):
        js.save_vtk(tmp_path / name, states, RING, **options)
    assert os.listdir(tmp_path) == []


def test_a_vector_is_written_in_the_users_order(rng, tmp_path):
    """A force is kept in the graph's own order and says so by its type: of one state and of frames, it is written node by node."""
    system = js.System(RING, 1.0, js.Springs(RING, 3.0, 0.5))
    one, other = random_state(RING, 2, rng, np.float32), random_state(RING, 2, rng, np.float32)
    expected = [np.stack([RING.flatten_nodes(a) for a in system.force(s)], axis=1) for s in (one, other)]
    assert not np.array_equal(expected[0][:, 0], system.force(one).x)
    js.save_xyz(tmp_path / "one.xyz", one, RING, {"force": system.force(one)})
    both = stacked(one, other)
    js.save_xyz(tmp_path / "both.xyz", both, RING, {"force": jax.vmap(system.force)(both)})
    for name, n in (("one", 1), ("both", 2)):
        for (_, frame), wanted in zip(read_xyz(tmp_path / f"{name}.xyz"), expected[:n], strict=True):
            np.testing.assert_array_equal(np.asarray(frame["force"], np.float32)[:, :2], wanted)


def test_a_link_stays_a_link(tmp_path):
    """Of a file or a folder: what it points to is written, nothing else appears."""
    (tmp_path / "disk").mkdir()
    (tmp_path / "run").symlink_to(tmp_path / "disk" / "run", target_is_directory=True)
    (tmp_path / "a.vtu").symlink_to(tmp_path / "disk" / "a.vtu")
    for _ in range(2):
        js.save_vtk(tmp_path / "run", frames(), RING)
        js.save_vtk(tmp_path / "a.vtu", ONE, RING)
    assert (tmp_path / "run").is_symlink()
    assert (tmp_path / "a.vtu").is_symlink()
    assert sorted(os.listdir(tmp_path)) == ["a.vtu", "disk", "run"]
    assert sorted(os.listdir(tmp_path / "disk")) == ["a.vtu", "run"]
    assert len(os.listdir(tmp_path / "run")) == 3


def test_a_net_that_is_none_is_named(tmp_path):
    """The states without their net."""
    with pytest.raises(TypeError, match="net is a NoneType; expected the topology of the states"):
        js.save_vtk(tmp_path / "a.vtu", ONE, None)


def test_a_run_without_whole_states_is_refused(tmp_path):
    """A result that saved nothing, or something else, says what to pass."""
    for saved in (None, jnp.zeros(3)):
        run = types.SimpleNamespace(saved=saved)
        for save in (js.save_vtk, js.save_xyz, js.save_ply):
            with pytest.raises(ValueError, match=r"kept no whole states.*pass result\.state"):
                save(tmp_path / "a", run, RING)


def test_what_is_traced_is_refused(tmp_path):
    """Inside `jit` there are no numbers: states, fields and edge fields say so."""
    with pytest.raises(TypeError, match="states are traced"):
        jax.jit(lambda s: js.save_xyz(tmp_path / "a.xyz", s, RING))(ONE)
    with pytest.raises(TypeError, match="points is traced"):
        jax.jit(lambda a: js.save_xyz(tmp_path / "a.xyz", ONE, RING))(1.0)
    for argument, lanes in (("node_fields", jnp.ones((2, 5))), ("spring_fields", jnp.ones((2, 5)))):
        for convert in (lambda a: a, RING.split) if argument == "spring_fields" else (lambda a: a,):
            with pytest.raises(TypeError, match=rf"{argument}\['a'\] is traced"):
                jax.vmap(lambda a, f=convert, n=argument: js.save_vtk(tmp_path / "a.vtu", ONE, RING, **{n: {"a": f(a)}}))(lanes)
    assert os.listdir(tmp_path) == []


def test_columns_of_one_name_are_refused(tmp_path):
    """In PLY a vector becomes three columns, which may not meet another field."""
    with pytest.raises(ValueError, match="'push_x'"):
        js.save_ply(tmp_path / "a.ply", ONE, RING, {"push": np.ones((5, 2)), "push_x": np.ones(5)})
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    ("save", "name", "states", "error", "words"),
    [
        (js.save_vtk, "a.vtk", ONE, ValueError, r"let the name end in \.vtu"),
        (js.save_vtk, "a", ONE, ValueError, r"let the name end in \.vtu"),
        (js.save_xyz, "a.txt", frames(), ValueError, r"let the name end in \.xyz or \.extxyz"),
        (js.save_ply, "a.stl", ONE, ValueError, r"let the name end in \.ply"),
        (js.save_vtk, "run.pvd", frames(), ValueError, r"is the name of a file, but 2 frames make a folder. Pass e\.g\. '.*run'"),
        (js.save_ply, "run.PLY", frames(), ValueError, "is the name of a file"),
        (js.save_vtk, "no/where/a.vtu", ONE, FileNotFoundError, "where is no folder"),
        (js.save_vtk, "no/where/run", frames(), FileNotFoundError, "where is no folder"),
        (js.save_vtk, "thesis", frames(), FileExistsError, r"holds other files \(chapter\.tex\)"),
        (js.save_ply, "notes", frames(), FileExistsError, "notes is a file"),
        (js.save_vtk, "folder.vtu", ONE, IsADirectoryError, "is a folder"),
    ],
)
def test_places_that_do_not_fit(save, name, states, error, words, tmp_path):
    """Endings by which no reader would know the file, folders that are missing or hold something else: named, and nothing is touched."""
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").touch()
    (tmp_path / "folder.vtu").mkdir()
    (tmp_path / "notes").touch()
    with pytest.raises(error, match=words):
        save(tmp_path / name, states, RING)
    assert sorted(os.listdir(tmp_path)) == ["folder.vtu", "notes", "thesis"]
    assert os.listdir(tmp_path / "thesis") == ["chapter.tex"]


@pytest.mark.parametrize("name", ["run.v2", "a & b <c>", 'say "so"', "größe", "100%", "run_0000"])
def test_odd_names(name, tmp_path):
    """Dots, blanks, signs of XML and other alphabets in a name: the list is well-formed, and its files are there."""
    js.save_vtk(tmp_path / name, frames(), RING)
    listed = ET.parse(tmp_path / name / f"{name}.pvd").getroot().findall("Collection/DataSet")
    assert sorted([one.get("file") for one in listed] + [f"{name}.pvd"]) == sorted(os.listdir(tmp_path / name))
    js.save_vtk(tmp_path / f"{name}.VTU", ONE, RING)
    js.save_ply(str(tmp_path / f"{name}.ply"), ONE, RING)
    assert len(trimesh.load(tmp_path / f"{name}.ply").vertices) == 5


def test_a_run_replaces_an_older_one_whole(tmp_path, monkeypatch):
    """A shorter run leaves no frame of the longer one; where a frame cannot be written, the older run is as it was."""
    js.save_vtk(tmp_path / "run", frames(5), RING)
    js.save_vtk(tmp_path / "run", frames(2), RING)
    before = {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()}
    assert sorted(before) == ["run.pvd", "run_0000.vtu", "run_0001.vtu"]

    def full(frames, i):
        if i == 1:
            raise OSError("No space left on device")
        return b"half"

    for module, name, save in ((vtk, "_grid", js.save_vtk), (ply, "_mesh", js.save_ply)):
        monkeypatch.setattr(module, name, full)
        with pytest.raises(OSError, match="No space"):
            save(tmp_path / ("run" if save is js.save_vtk else "other"), frames(3), RING)
    assert {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()} == before
    assert os.listdir(tmp_path) == ["run"]


def test_more_frames_than_four_digits(tmp_path):
    """Names stay in the order of time, and a later series of other digits may replace them."""
    with places.series_folder(tmp_path / "run", ".vtu", ".pvd", 10_001) as (folder, names):
        for name in (names[0], names[-1]):
            (folder / name).touch()
    assert sorted(os.listdir(tmp_path / "run")) == [names[0], names[-1]] == ["run_00000.vtu", "run_10000.vtu"]
    js.save_vtk(tmp_path / "run", frames(), RING)
    assert len(os.listdir(tmp_path / "run")) == 3
