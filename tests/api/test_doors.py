"""What a user passes in is copied, understood, or refused by name: at every public name that takes arrays (see `tests/doors.py`)."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests import face
from tests.doors import BY_HAND, DOORS, MADE_INSIDE, NO_ARRAYS, at_offset, snapshot, spoil

FIELDS = [(name, field) for name, door in DOORS.items() for field in door.fields]
each_door = pytest.mark.parametrize("name", DOORS)
each_field = pytest.mark.parametrize(("name", "field"), FIELDS, ids=lambda value: value)


def test_every_public_name_has_its_door():
    """A public class or function stands in the table of doors, or among those that take no array of the user's."""
    listed = [set(DOORS), BY_HAND, set(MADE_INSIDE.split()), set(NO_ARRAYS.split())]
    public = {name for name, thing in face.public().items() if inspect.isclass(thing) or inspect.isroutine(thing)}
    missing = sorted(public - set().union(*listed))
    assert not missing, f"tests/doors.py does not know {', '.join(missing)}: say how each is built from arrays, or that it takes none"
    assert sum(map(len, listed)) == len(set().union(*listed)), "a name is listed twice"
    assert set().union(*listed) <= public


@each_door
def test_arrays_are_copied(name, dtype):
    """An array that is changed after the call changes nothing that was built from it, however it lies in memory."""
    door = DOORS[name]
    for offset in (0, dtype.itemsize):
        given = {field: at_offset(value, dtype, offset) for field, value in door.fields.items()}
        built = door.build(**given)
        before = snapshot(built)
        assert before or name in ("from_triangles", "delaunay")
        for array in given.values():
            spoil(array)
        for a, b in zip(before, snapshot(built), strict=True):
            np.testing.assert_array_equal(a, b)


class Table:
    """What tables of other packages look like: an object that NumPy can read."""

    def __init__(self, values):
        self.values = values

    def __array__(self, dtype=None, copy=None):
        return np.array(self.values, dtype)


def read_only(a):
    a = a.copy()
    a.setflags(write=False)
    return a


def mapped(a):
    return a.copy().view(np.memmap)


# Each holds the same numbers as the plain array.
FORMS = {
    "list": lambda a: a.tolist(),
    "tuple": lambda a: tuple(map(tuple, a.tolist())) if a.ndim == 2 else tuple(a.tolist()) if a.ndim else a.item(),
    "big-endian": lambda a: a.astype(a.dtype.newbyteorder(">")),
    "long double": lambda a: a.astype(np.longdouble) if a.dtype.kind == "f" else a,
    "objects": lambda a: a.astype(object),
    "list of arrays": lambda a: list(a) if a.ndim else a,
    "generator": lambda a: (row for row in a.tolist()) if a.ndim else a,
    "Fortran": lambda a: a.copy(order="F"),
    "view": lambda a: np.repeat(a, 2, axis=0)[::2] if a.ndim else a,
    "read-only": read_only,
    "memory-mapped": mapped,
    "no mask": np.ma.masked_array,
    "table": Table,
    "of JAX": lambda a: jnp.asarray(a.copy()),
}


def masked(a):
    mask = np.zeros(a.shape, bool)
    mask[(0,) * a.ndim] = True
    return np.ma.masked_array(a, mask)


def with_none(a):
    a = a.astype(object)
    a[(0,) * a.ndim] = None
    return a


# Each must be refused with a sentence that names the field.
BAD = {
    "masked": masked,
    "text": lambda a: a.astype(str),
    "dates": lambda a: a.astype("i8").astype("M8[s]"),
    "complex": lambda a: a + 1j,
    "none": with_none,
    "a set": lambda a: {1.0, 2.0},
    "a word": lambda a: "three",
    "nan": lambda a: a * np.nan if a.dtype.kind == "f" else a.astype(float),
    "another kind": lambda a: a.astype(float) if a.dtype == bool else a.astype(bool),
    "an axis more": lambda a: a[None, None, None],
    "ragged": lambda a: [[1.0, 2.0], [1.0]],
}


# A tree of any leaves: what it holds is judged where it is used.
ANY_LEAF = {"Vector", "EdgeField", "Motion"}
# Colours, masks and fill values: with the tests of images.
OF_IMAGES = {"image_from_array"}


@each_field
def test_every_form_of_an_array_is_read_alike(name, field):
    """Lists, foreign byte orders, long doubles, objects, generators, tables, views: the same numbers, the same object."""
    if name in OF_IMAGES:
        pytest.skip("with the tests of images")
    door = DOORS[name]
    plain = {f: np.array(value) for f, value in door.fields.items()}
    expected = snapshot(door.build(**plain))
    for form, convert in FORMS.items():
        if name in ANY_LEAF and form in ("tuple", "generator", "table", "no mask"):
            continue
        found = snapshot(door.build(**{**plain, field: convert(plain[field])}))
        for a, b in zip(expected, found, strict=True):
            np.testing.assert_array_equal(a, b, err_msg=form)
            assert a.dtype == b.dtype, form


@each_field
def test_what_holds_no_numbers_is_refused_by_name(name, field):
    """Masked entries, text, dates, complex numbers, None, NaN, a wrong shape: a TypeError or ValueError that names the field."""
    if name in ANY_LEAF | OF_IMAGES:
        pytest.skip("holds leaves of any kind, or is with the tests of images")
    door = DOORS[name]
    for form, convert in BAD.items():
        good = np.array(door.fields[field])
        if form == "another kind" and (field in ("values", "matrix") or (name, field) == ("Image", "weights")):
            continue  # pixels, their weights and adjacency may be booleans
        if form == "nan" and field == "box":
            continue  # periods are looked at with the tests of boxes
        given = {**{f: np.array(v) for f, v in door.fields.items()}, field: convert(good)}
        with pytest.raises((TypeError, ValueError)) as caught:
            door.build(**given)
        assert field.rstrip("s") in str(caught.value).replace(" ", "_"), f"{form}: {caught.value}"


@each_field
def test_traced_numbers_in_a_list(name, field):
    """A list of traced numbers is an array; where an array must be known, a sentence says so by name."""
    door = DOORS[name]
    plain = {f: np.array(value) for f, value in door.fields.items()}
    if name in ANY_LEAF | OF_IMAGES or plain[field].dtype != float or not plain[field].ndim:
        pytest.skip("no list of numbers")

    def build(a):
        rows = [list(row) for row in a] if a.ndim == 2 else list(a)
        return [leaf for leaf in jax.tree.leaves(door.build(**{**plain, field: rows})) if isinstance(leaf, jax.Array)]

    if field in door.on_host:
        with pytest.raises((TypeError, ValueError), match=f"{field}.*traced"):
            jax.eval_shape(build, plain[field])
    else:
        assert jax.eval_shape(build, plain[field])
