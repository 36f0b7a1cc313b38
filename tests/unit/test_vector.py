"""Vectors: one array per coordinate, with the arithmetic of NumPy arrays stacked along the coordinates."""

import operator

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js


def stacked(v):
    return np.stack([np.asarray(a) for a in v])


@pytest.fixture
def pair(rng):
    """Two vectors of 3 coordinates in the node shape (2, 5)."""
    a, b = rng.normal(size=(2, 3, 2, 5)) + 3
    return js.Vector(tuple(jnp.asarray(c) for c in a)), js.Vector(tuple(jnp.asarray(c) for c in b))


@pytest.mark.parametrize("op", [operator.add, operator.sub, operator.mul, operator.truediv])
def test_arithmetic_is_that_of_the_stacked_array(op, pair):
    """Vector op vector, number or node array is what NumPy gives coordinate by coordinate."""
    a, b = pair
    weights = jnp.arange(1.0, 11.0).reshape(2, 5)
    for other, expected in ((b, stacked(b)), (2.5, 2.5), (weights, np.asarray(weights))):
        np.testing.assert_allclose(stacked(op(a, other)), op(stacked(a), expected), rtol=1e-15)


@pytest.mark.parametrize("op", [operator.add, operator.sub, operator.mul])
def test_arithmetic_from_the_left(op, pair):
    """Number op vector and array op vector are Vectors, for Python, NumPy and JAX operands: never an object array."""
    a, _ = pair
    weights = np.arange(1.0, 11.0).reshape(2, 5)
    for left in (2.5, np.float64(2.5), np.float32(2.5), weights, jnp.asarray(weights)):
        got = op(left, a)
        assert isinstance(got, js.Vector)
        np.testing.assert_array_equal(stacked(got), op(np.asarray(left), stacked(a)))


def test_dot_norm_and_negative(pair):
    """Dot product, norm and the negative are NumPy's along the coordinate axis."""
    a, b = pair
    np.testing.assert_allclose(a.dot(b), (stacked(a) * stacked(b)).sum(axis=0), rtol=1e-15)
    np.testing.assert_allclose(a.norm(), np.linalg.norm(stacked(a), axis=0), rtol=1e-15)
    np.testing.assert_array_equal(stacked(-a), -stacked(a))


def test_norm_of_zero_has_derivative_zero():
    """At length zero the norm is 0 and its first derivatives are 0, not NaN, in both modes."""

    def length(x, y):
        return js.Vector((x, y)).norm()

    zero = jnp.zeros(())
    assert length(zero, zero) == 0
    assert jax.grad(length)(zero, zero) == 0
    assert jax.jacfwd(length)(zero, zero) == 0


def test_float32_stays_float32():
    """A float32 vector stays so beside Python and NumPy float64 numbers."""
    v = js.Vector((jnp.ones(2, jnp.float32),))
    for got in (v * 2.0, np.float64(2) * v, v + np.ones(2), v / np.float64(3)):
        assert got.dtype == jnp.float32


def test_shape_and_coordinates(pair):
    """Dimension, shape, x y z, iteration and indexing agree with the arrays put in."""
    a, _ = pair
    assert (a.dim, a.shape, len(a)) == (3, (2, 5), 3)
    assert a.x is a[0]
    assert a.y is a[1]
    assert a.z is a[2]
    assert [c is d for c, d in zip(a, a.components, strict=True)] == [True] * 3


def test_vectors_of_different_dimension_do_not_mix(pair):
    """Adding or dotting vectors of 2 and 3 coordinates is an error that names both."""
    a, _ = pair
    flat = js.Vector((a.x, a.y))
    with pytest.raises(ValueError, match="3 and 2"):
        a + flat
    with pytest.raises(ValueError, match="2 and 3"):
        flat.dot(a)


def test_nonsense_operands_are_type_errors(pair):
    """A list or a string is a TypeError."""
    for wrong in ([1.0, 2.0], "x", None):
        with pytest.raises(TypeError):
            pair[0] + wrong
