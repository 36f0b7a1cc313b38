/* Lattices of springs, and heat, by hand: component arrays, sixteen nodes of a row at a time, every spring computed once.

   A row's pulls are kept until the rows that they act on have been reached. Rows have a border that nothing moves: a spring that does not
   exist has k = 0. Positions are read from one buffer and written to the next, so that threads meet once a step. A row holds n values, a
   multiple of 16, with offsets along it times `lanes`: 1, or 16 where 16 cloths stand side by side. */

#include "vectors.h"
#include <stdlib.h>

#define PAD 16
#define FAMILIES 6
#define UNROLL _Pragma("GCC unroll 6")
static const int DOWN[FAMILIES] = {0, 1, 1, 1, 0, 2};
static const int RIGHT[FAMILIES] = {1, 0, 1, -1, 2, 0};

typedef struct {
    int rows, n, lanes, stride;
    const float *k, *l; /* (FAMILIES, rows, n), without a border */
} Net;

static Net make_net(int rows, int n, int lanes, const float *k, const float *l) {
    Net net = {rows, n * lanes, lanes, (n + PAD) * lanes, k, l};
    return net;
}

/* Pulls of three rows, (3, FAMILIES, components, stride), and behind them the sums at the tails of one, (components, stride). */
static float *new_pulls(const Net *net) { return calloc((size_t)(3 * FAMILIES + 1) * 3 * net->stride, sizeof(float)); }

static inline float *kept(float *pulls, const Net *net, int row, int family, int component) {
    return pulls + (((long)((row + 3) % 3) * FAMILIES + family) * 3 + component) * net->stride + PAD * net->lanes;
}

static inline float *sums(float *pulls, const Net *net, int component) { return pulls + (9L * FAMILIES + component) * net->stride; }

/* Pulls of the springs whose tails are in a row, and their sum at the tails. */
static inline void pull_row(const Net *net, int i, float *const x[3], float *pulls) {
    const long row = (long)i * net->stride + PAD * net->lanes, plane = (long)net->rows * net->n;
    for (int j = 0; j < net->n; j += LANES) {
        const v16 x0 = load(x[0] + row + j), x1 = load(x[1] + row + j), x2 = load(x[2] + row + j);
        v16 s0 = {0}, s1 = {0}, s2 = {0};
        UNROLL for (int f = 0; f < FAMILIES; f++) {
            const long head = row + j + (long)DOWN[f] * net->stride + RIGHT[f] * net->lanes, here = f * plane + (long)i * net->n + j;
            const v16 d0 = load(x[0] + head) - x0, d1 = load(x[1] + head) - x1, d2 = load(x[2] + head) - x2;
            const v16 w = load(net->k + here) * (1.0f - load(net->l + here) * inverse_root(d0 * d0 + d1 * d1 + d2 * d2));
            const v16 p0 = w * d0, p1 = w * d1, p2 = w * d2;
            store(kept(pulls, net, i, f, 0) + j, p0), store(kept(pulls, net, i, f, 1) + j, p1), store(kept(pulls, net, i, f, 2) + j, p2);
            s0 += p0, s1 += p1, s2 += p2;
        }
        store(sums(pulls, net, 0) + j, s0), store(sums(pulls, net, 1) + j, s1), store(sums(pulls, net, 2) + j, s2);
    }
}

/* What the springs with an end in row i add up to there. */
static inline v16 pulled(const Net *net, float *pulls, int i, int c, int j) {
    v16 sum = load(sums(pulls, net, c) + j);
    UNROLL for (int f = 0; f < FAMILIES; f++) sum -= load(kept(pulls, net, i - DOWN[f], f, c) + j - RIGHT[f] * net->lanes);
    return sum;
}

static inline void move_row(const Net *net, int i, float *pulls, float *const x[3], float *const next[3], float *const v[3], float dt) {
    const long row = (long)i * net->stride + PAD * net->lanes;
    for (int c = 0; c < 3; c++)
        for (int j = 0; j < net->n; j += LANES) {
            const v16 u = load(v[c] + row + j) + dt * pulled(net, pulls, i, c, j);
            store(v[c] + row + j, u);
            store(next[c] + row + j, load(x[c] + row + j) + dt * u);
        }
}

/* x: (history, 3, rows + 2, stride), the first filled; v: (3, rows + 2, stride). Step t writes x[(t + 1) % history]. */
void cloth(int rows, int n, int lanes, const float *k, const float *l, float *x, float *v, float dt, int n_steps, int history,
           int threads) {
    const Net net = make_net(rows, n, lanes, k, l);
    const long plane = (long)(rows + 2) * net.stride;
    float *const speed[3] = {v, v + plane, v + 2 * plane};
    Meeting meeting = {0, 0};
#pragma omp parallel num_threads(threads) if (threads > 1)
    {
        const int me = omp_get_thread_num(), begin = rows * me / threads, end = rows * (me + 1) / threads;
        float *pulls = new_pulls(&net);
        for (int t = 0; t < n_steps; t++) {
            float *a = x + (t % history) * 3 * plane, *b = x + ((t + 1) % history) * 3 * plane;
            float *const from[3] = {a, a + plane, a + 2 * plane}, *const to[3] = {b, b + plane, b + 2 * plane};
            memset(pulls, 0, sizeof(float) * 9 * FAMILIES * net.stride);
            for (int i = begin >= 2 ? begin - 2 : 0; i < end; i++) {
                pull_row(&net, i, from, pulls);
                if (i >= begin) move_row(&net, i, pulls, from, to, speed, dt);
            }
            meet(&meeting, threads);
        }
        free(pulls);
    }
}

/* Many blocks of 16 cloths side by side, each through all its steps at once. x: (blocks, 2, 3, rows + 2, stride); v without the 2. */
void cloths(int blocks, int rows, int n, const float *k, const float *l, float *x, float *v, float dt, int n_steps, int threads) {
    const long springs = (long)FAMILIES * rows * n * LANES, plane = (long)(rows + 2) * (n + PAD) * LANES;
#pragma omp parallel for num_threads(threads) schedule(static)
    for (int b = 0; b < blocks; b++) cloth(rows, n, LANES, k + b * springs, l, x + b * 6 * plane, v + b * 3 * plane, dt, n_steps, 2, 1);
}

/* One row of a step of the adjoint. With a = b_tail - b_head: g = k [(1 - l/L) a + l/L (u.a) u], added at the head, taken at the tail. */
static inline void adjoint_row(const Net *net, int i, float *const x[3], float *const b[3], float *pulls, float *of_k, float *of_l,
                               float dt) {
    const long row = (long)i * net->stride + PAD, plane = (long)net->rows * net->n;
    for (int j = 0; j < net->n; j += LANES) {
        const v16 x0 = load(x[0] + row + j), x1 = load(x[1] + row + j), x2 = load(x[2] + row + j);
        const v16 b0 = load(b[0] + row + j), b1 = load(b[1] + row + j), b2 = load(b[2] + row + j);
        v16 s0 = {0}, s1 = {0}, s2 = {0};
        UNROLL for (int f = 0; f < FAMILIES; f++) {
            const long head = row + j + (long)DOWN[f] * net->stride + RIGHT[f], here = f * plane + (long)i * net->n + j;
            const v16 d0 = load(x[0] + head) - x0, d1 = load(x[1] + head) - x1, d2 = load(x[2] + head) - x2;
            const v16 a0 = dt * (b0 - load(b[0] + head)), a1 = dt * (b1 - load(b[1] + head)), a2 = dt * (b2 - load(b[2] + head));
            const v16 k = load(net->k + here), l = load(net->l + here), r = inverse_root(d0 * d0 + d1 * d1 + d2 * d2);
            const v16 along = d0 * a0 + d1 * a1 + d2 * a2, stretch = 1.0f - l * r, w = k * stretch, turn = k * l * r * r * r * along;
            const v16 p0 = w * a0 + turn * d0, p1 = w * a1 + turn * d1, p2 = w * a2 + turn * d2;
            store(kept(pulls, net, i, f, 0) + j, p0), store(kept(pulls, net, i, f, 1) + j, p1), store(kept(pulls, net, i, f, 2) + j, p2);
            s0 += p0, s1 += p1, s2 += p2;
            if (of_k) {
                store(of_k + here, load(of_k + here) + stretch * along);
                store(of_l + here, load(of_l + here) - k * r * along);
            }
        }
        store(sums(pulls, net, 0) + j, s0), store(sums(pulls, net, 1) + j, s1), store(sums(pulls, net, 2) + j, s2);
    }
}

/* g: gradient by the positions; b, next: by the velocities, before and after. */
static inline void back_row(const Net *net, int i, float *pulls, float *const g[3], float *const b[3], float *const next[3], float dt) {
    const long row = (long)i * net->stride + PAD;
    for (int c = 0; c < 3; c++)
        for (int j = 0; j < net->n; j += LANES) {
            const v16 of_x = load(g[c] + row + j) - pulled(net, pulls, i, c, j);
            store(g[c] + row + j, of_x);
            store(next[c] + row + j, load(b[c] + row + j) + dt * of_x);
        }
}

/* After `cloth` with a whole history: the gradient of the sum of squared last positions. g: (3, rows + 2, stride) and b: (2, 3, ...) zeros;
   of_k, of_l: (FAMILIES, rows, n) zeros, filled. */
void cloth_gradient(int rows, int n, const float *k, const float *l, float *x, float *g, float *b, float *of_k, float *of_l, float dt,
                    int n_steps, int threads) {
    const Net net = make_net(rows, n, 1, k, l);
    const long plane = (long)(rows + 2) * net.stride;
    const float *last = x + 3 * n_steps * plane;
    for (int c = 0; c < 3; c++)
        for (int i = 0; i < rows; i++)
            for (int j = 0; j < n; j++) {
                const long at = c * plane + (long)i * net.stride + PAD + j;
                g[at] = 2 * last[at];
                b[at] = dt * g[at];
            }
    float *const of_x[3] = {g, g + plane, g + 2 * plane};
    Meeting meeting = {0, 0};
#pragma omp parallel num_threads(threads) if (threads > 1)
    {
        const int me = omp_get_thread_num(), begin = rows * me / threads, end = rows * (me + 1) / threads;
        float *pulls = new_pulls(&net);
        for (int t = n_steps - 1; t >= 0; t--) {
            float *a = x + 3 * t * plane, *p = b + ((n_steps - 1 - t) % 2) * 3 * plane, *q = b + ((n_steps - t) % 2) * 3 * plane;
            float *const at[3] = {a, a + plane, a + 2 * plane}, *const from[3] = {p, p + plane, p + 2 * plane};
            float *const to[3] = {q, q + plane, q + 2 * plane};
            memset(pulls, 0, sizeof(float) * 9 * FAMILIES * net.stride);
            for (int i = begin >= 2 ? begin - 2 : 0; i < end; i++) {
                const int mine = i >= begin; /* two rows above are another thread's: their pulls alone are wanted */
                adjoint_row(&net, i, at, from, pulls, mine ? of_k : 0, mine ? of_l : 0, dt);
                if (mine) back_row(&net, i, pulls, of_x, from, to, dt);
            }
            meet(&meeting, threads);
        }
        free(pulls);
    }
}

/* Explicit conduction in a block: temperature (2, nz + 2, ny + 2, nx + 16), in the same shape the conductances at the lower
   node of each axis, zero beyond borders. */
void heat(int nz, int ny, int nx, const float *gx, const float *gy, const float *gz, float *temperature, float dt, int n_steps,
          int threads) {
    const long row = nx + PAD, layer = (ny + 2) * row, whole = (nz + 2) * layer;
    Meeting meeting = {0, 0};
#pragma omp parallel num_threads(threads) if (threads > 1)
    {
        const int me = omp_get_thread_num(), begin = 1 + nz * me / threads, end = 1 + nz * (me + 1) / threads;
        for (int t = 0; t < n_steps; t++) {
            const float *restrict old = temperature + (t % 2) * whole;
            float *restrict new = temperature + ((t + 1) % 2) * whole;
            for (int z = begin; z < end; z++)
                for (int y = 1; y <= ny; y++) {
                    const long at = z * layer + y * row + PAD - 1;
                    for (long i = at; i < at + nx; i++)
                        new[i] = old[i] + dt * (gx[i] * (old[i + 1] - old[i]) - gx[i - 1] * (old[i] - old[i - 1])
                                                + gy[i] * (old[i + row] - old[i]) - gy[i - row] * (old[i] - old[i - row])
                                                + gz[i] * (old[i + layer] - old[i]) - gz[i - layer] * (old[i] - old[i - layer]));
                }
            meet(&meeting, threads);
        }
    }
}
