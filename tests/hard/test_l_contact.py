"""Hard cases L1 to L4 on obstacles of any form: bounces, slides and corners are right in value and derivative, and nothing goes through."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxspring as js
from jaxspring.contact import Contact

PAIR = js.lattice(2)


class Body(js.contact.Obstacle):
    """A disc, or a plane that swings along y; which of them, by `is_disc`."""

    centre: jax.Array
    normal: jax.Array
    radius: jax.Array
    swing: jax.Array
    is_disc: jax.Array

    def distance(self, position, time):
        here = position - js.Vector((self.centre[0], self.centre[1] + self.swing[0] * jnp.sin(self.swing[1] * time)))
        plane = here.dot(js.Vector((self.normal[0], self.normal[1])))
        return jnp.where(self.is_disc > 0, here.norm() - self.radius, plane)

    @property
    def moves(self):
        return True


class Well(js.Force):
    """A spring of length zero to height 1, vertical."""

    stiffness: jax.Array

    def force(self, state):
        return js.Vector((jnp.zeros_like(state.position.x), -self.stiffness * (state.position.y - 1)))

    def energy(self, state):
        return 0.5 * jnp.sum(self.stiffness * (state.position.y - 1) ** 2)


# x, y, vx, vy of two nodes; e, g, R, amplitude, frequency, stiffness of the well, drag, dashpot, T; is_disc, slope of the second plane
NAMES = "x0 y0 vx0 vy0 x1 y1 vx1 vy1 e g R A w k c cd T".split()
FAR = (50.0, 50.0, 0.0, 0.0)
CASES = {
    #            node 0               node 1                 e    g     R    A    w    k     c    cd   T     disc  corner
    "plane": (0.2, 1.0, 0.5, 0.3, *FAR, 0.8, 10.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.75, 0, 0),
    "moving plane": (0.2, 1.0, 0.5, 0.3, *FAR, 0.8, 10.0, 1.0, 0.1, 5.0, 0.0, 0.0, 0.0, 0.75, 0, 0),
    "disc": (-0.4, 1.6, 1.0, -1.0, *FAR, 0.8, 10.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.6, 1, 0),
    "moving disc": (-0.4, 1.6, 1.0, -1.0, *FAR, 1.0, 10.0, 1.0, 0.05, 7.0, 0.0, 0.0, 0.0, 0.6, 1, 0),
    "corner": (0.9, 1.3, 0.5, 0.0, *FAR, 0.8, 10.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0, 1),
    "spring": (0.0, 1.0, 0.0, -8.0, *FAR, 0.7, 5.0, 1.0, 0.0, 1.0, 30.0, 0.0, 0.0, 0.7, 0, 0),
    "drag": (0.0, 1.0, 0.0, -1.0, *FAR, 0.8, 10.0, 1.0, 0.0, 1.0, 0.0, 1.5, 0.0, 0.75, 0, 0),
    "dashpot": (0.0, 0.6, 0.0, -2.0, 0.0, 1.5, 0.0, -0.5, 0.7, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.9, 1.0, 0, 0),
}
N_STEPS = 400


def obstacles(p, disc, corner):
    """A body, and a wall to the left, far away where the scene has no corner."""
    nought, one = jnp.zeros(()), jnp.ones(())
    tilt = jnp.where(corner > 0, np.pi / 4, 0.0)
    first = Body(jnp.zeros(2), jnp.stack([jnp.sin(tilt), jnp.cos(tilt)]), p[10], p[11:13], disc)
    wall = jnp.stack([jnp.cos(tilt), -jnp.sin(tilt)])
    at = jnp.where(corner > 0, 0.0, 1e3) * wall
    second = Body(-at if False else at * -1.0, wall, one, jnp.stack([nought, one]), nought)
    return first, second


def ended(p, flags):
    """Where both nodes are at T, and the status."""
    start = js.State.from_points(PAIR, jnp.stack([p[0:2], p[4:6]]), jnp.stack([p[2:4], p[6:8]]))
    nought = jnp.zeros(())
    forces = (js.Gravity(jnp.stack([nought, -p[9]])), Well(p[13]), js.Drag(p[14]), js.Dashpots(PAIR, p[15]))
    rules = tuple(Contact(body, 0.0, p[8]) for body in obstacles(p, *flags))
    run = js.rollout(js.System(PAIR, 1.0, forces, rules=rules), start, js.VelocityVerlet(), p[16] / N_STEPS, N_STEPS)
    return run.state.points.ravel(), run.status.flags


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_numpy_dtype_promotion", "strict")
    jax.config.update("jax_numpy_rank_promotion", "raise")
    import time
    rows = np.array(list(CASES.values()))
    def f(row):
        p, flags = row[:17], (row[17], row[18])
        x, push, st = jax.linearize(lambda p: ended(p, flags), p, has_aux=True)
        return x, jax.vmap(push)(jnp.eye(17)), st
    t = time.process_time(); l = jax.jit(jax.vmap(f)).lower(rows); t1 = time.process_time(); c = l.compile(); print(t1 - t, time.process_time() - t1)
    t = time.time(); out = jax.block_until_ready(c(rows)); print("run", time.time() - t)
    np.set_printoptions(precision=6, suppress=True, linewidth=170)
    for n, x, d, s in zip(CASES, *out):
        print(n, x, s); print(d[:, 1 if n!="disc" else 0])
