/* Lattices of springs, and heat, by hand: component arrays, one vector loop for each row, every spring computed once.

   A row's pulls are kept until the rows that they act on have been reached. Rows have a border that nothing moves: a spring that does not
   exist has k = 0. Positions are read from one buffer and written to the next, so that threads meet once a step. A row holds n values,
   with offsets along it times `lanes`: 1, or 16 where 16 cloths stand side by side. */

#include <math.h>
#include <stdlib.h>
#include <string.h>
#ifdef _OPENMP
#include <omp.h>
#else
#define omp_get_thread_num() 0
#endif

#define PAD 16
#define FAMILIES 6
static const int DOWN[FAMILIES] = {0, 1, 1, 1, 0, 2};
static const int RIGHT[FAMILIES] = {1, 0, 1, -1, 2, 0};
#define ROW(a, i) ((a) + (long)(i) * stride + left)

typedef struct {
    int rows, n, lanes, stride;
    const float *k[FAMILIES], *l[FAMILIES]; /* rows x n, without a border */
} Net;

/* Pulls of three rows: (3, FAMILIES, components, stride). */
static float *kept_rows(int stride) { return calloc((size_t)3 * FAMILIES * 3 * stride, sizeof(float)); }

static inline float *kept(float *pulls, int stride, int row, int family, int component) {
    return pulls + (((long)((row + 3) % 3) * FAMILIES + family) * 3 + component) * stride;
}

/* The springs of one row and family: x at the tails, h at the heads; p the pulls, s their sums at the tails. */
static void pull_family(int n, const float *restrict k, const float *restrict l, const float *x0, const float *x1, const float *x2,
                        const float *h0, const float *h1, const float *h2, float *restrict p0, float *restrict p1, float *restrict p2,
                        float *restrict s0, float *restrict s1, float *restrict s2) {
    for (int j = 0; j < n; j++) {
        const float d0 = h0[j] - x0[j], d1 = h1[j] - x1[j], d2 = h2[j] - x2[j];
        const float w = k[j] * (1.0f - l[j] / sqrtf(d0 * d0 + d1 * d1 + d2 * d2));
        p0[j] = w * d0, p1[j] = w * d1, p2[j] = w * d2;
        s0[j] += p0[j], s1[j] += p1[j], s2[j] += p2[j];
    }
}

/* Pulls of the springs whose tails are in a row, and their sum at the tails. */
static void pull_row(const Net *net, int i, float *const x[3], float *pulls, float *sum) {
    const int n = net->n, stride = net->stride, left = PAD * net->lanes;
    memset(sum, 0, sizeof(float) * 3 * stride);
    for (int f = 0; f < FAMILIES; f++) {
        const long head = (long)DOWN[f] * stride + RIGHT[f] * net->lanes;
        const float *x0 = ROW(x[0], i), *x1 = ROW(x[1], i), *x2 = ROW(x[2], i);
        float *p0 = kept(pulls, stride, i, f, 0) + left, *p1 = kept(pulls, stride, i, f, 1) + left;
        float *p2 = kept(pulls, stride, i, f, 2) + left;
        pull_family(n, net->k[f] + (long)i * n, net->l[f] + (long)i * n, x0, x1, x2, x0 + head, x1 + head, x2 + head, p0, p1, p2, sum,
                    sum + stride, sum + 2 * stride);
    }
}

/* What the springs whose heads are in row i take from it, for one component. */
#define COMING(c, j) \
    (kept(pulls, stride, i, 0, c)[left + (j) - lanes] + kept(pulls, stride, i, 4, c)[left + (j) - 2 * lanes] \
     + kept(pulls, stride, i - 1, 1, c)[left + (j)] + kept(pulls, stride, i - 1, 2, c)[left + (j) - lanes] \
     + kept(pulls, stride, i - 1, 3, c)[left + (j) + lanes] + kept(pulls, stride, i - 2, 5, c)[left + (j)])

static void move_row(const Net *net, int i, float *pulls, const float *sum, float *const x[3], float *const next[3], float *const v[3],
                     float dt) {
    const int n = net->n, stride = net->stride, lanes = net->lanes, left = PAD * lanes;
    for (int c = 0; c < 3; c++) {
        const float *restrict from = ROW(x[c], i), *restrict s = sum + c * stride;
        float *restrict to = ROW(next[c], i), *restrict speed = ROW(v[c], i);
        for (int j = 0; j < n; j++) {
            const float u = speed[j] + dt * (s[j] - COMING(c, j));
            speed[j] = u;
            to[j] = from[j] + dt * u;
        }
    }
}

static void step_rows(const Net *net, int begin, int end, float *pulls, float *sum, float *const x[3], float *const next[3],
                      float *const v[3], float dt) {
    memset(pulls, 0, sizeof(float) * 3 * FAMILIES * 3 * net->stride);
    for (int i = begin >= 2 ? begin - 2 : 0; i < begin; i++) pull_row(net, i, x, pulls, sum);
    for (int i = begin; i < end; i++) {
        pull_row(net, i, x, pulls, sum);
        move_row(net, i, pulls, sum, x, next, v, dt);
    }
}

static Net make_net(int rows, int n, int lanes, const float *k, const float *l) {
    Net net = {rows, n * lanes, lanes, (n + PAD) * lanes, {0}, {0}};
    for (int f = 0; f < FAMILIES; f++) {
        net.k[f] = k + (long)f * rows * n * lanes;
        net.l[f] = l + (long)f * rows * n * lanes;
    }
    return net;
}

/* x: (history, 3, rows + 2, stride), the first filled; v: (3, rows + 2, stride). Step t writes x[(t + 1) % history]. */
void cloth(int rows, int n, int lanes, const float *k, const float *l, float *x, float *v, float dt, int n_steps, int history,
           int threads) {
    const Net net = make_net(rows, n, lanes, k, l);
    const long plane = (long)(rows + 2) * net.stride;
#pragma omp parallel num_threads(threads) if (threads > 1)
    {
        const int me = omp_get_thread_num(), begin = rows * me / threads, end = rows * (me + 1) / threads;
        float *pulls = kept_rows(net.stride), *sum = calloc(3 * net.stride, sizeof(float));
        for (int t = 0; t < n_steps; t++) {
            float *a = x + (t % history) * 3 * plane, *b = x + ((t + 1) % history) * 3 * plane;
            float *from[3] = {a, a + plane, a + 2 * plane}, *to[3] = {b, b + plane, b + 2 * plane};
            float *speed[3] = {v, v + plane, v + 2 * plane};
            step_rows(&net, begin, end, pulls, sum, from, to, speed, dt);
#pragma omp barrier
        }
        free(pulls), free(sum);
    }
}

/* Many blocks of 16 cloths side by side, each through all its steps at once. x: (blocks, 2, 3, rows + 2, stride); v without the 2. */
void cloths(int blocks, int rows, int n, const float *k, const float *l, float *x, float *v, float dt, int n_steps, int threads) {
    const long springs = (long)FAMILIES * rows * n * 16, plane = (long)(rows + 2) * (n + PAD) * 16;
#pragma omp parallel for num_threads(threads) schedule(static)
    for (int b = 0; b < blocks; b++) cloth(rows, n, 16, k + b * springs, l, x + b * 6 * plane, v + b * 3 * plane, dt, n_steps, 2, 1);
}

/* With a = b_tail - b_head: g = k [(1 - l/L) a + l/L (u.a) u], added at the head and taken at the tail; b at the tails, c at the heads. */
static void adjoint_family(int n, const float *restrict k, const float *restrict l, const float *x0, const float *x1, const float *x2,
                           const float *h0, const float *h1, const float *h2, const float *b0, const float *b1, const float *b2,
                           const float *c0, const float *c1, const float *c2, float *restrict p0, float *restrict p1, float *restrict p2,
                           float *restrict s0, float *restrict s1, float *restrict s2, float *restrict gk, float *restrict gl, float dt) {
    for (int j = 0; j < n; j++) {
        const float d0 = h0[j] - x0[j], d1 = h1[j] - x1[j], d2 = h2[j] - x2[j];
        const float a0 = dt * (b0[j] - c0[j]), a1 = dt * (b1[j] - c1[j]), a2 = dt * (b2[j] - c2[j]);
        const float r = 1.0f / sqrtf(d0 * d0 + d1 * d1 + d2 * d2), along = d0 * a0 + d1 * a1 + d2 * a2;
        const float stretch = 1.0f - l[j] * r, w = k[j] * stretch, turn = k[j] * l[j] * r * r * r * along;
        p0[j] = w * a0 + turn * d0, p1[j] = w * a1 + turn * d1, p2[j] = w * a2 + turn * d2;
        s0[j] += p0[j], s1[j] += p1[j], s2[j] += p2[j];
        gk[j] += stretch * along;
        gl[j] -= k[j] * r * along;
    }
}

/* One row of a step of the adjoint. */
static void adjoint_row(const Net *net, int i, float *const x[3], float *const b[3], float *pulls, float *sum, float *of_k, float *of_l,
                        float dt) {
    const int n = net->n, stride = net->stride, left = PAD;
    memset(sum, 0, sizeof(float) * 3 * stride);
    for (int f = 0; f < FAMILIES; f++) {
        const long head = (long)DOWN[f] * stride + RIGHT[f], here = ((long)f * net->rows + i) * n;
        const float *x0 = ROW(x[0], i), *x1 = ROW(x[1], i), *x2 = ROW(x[2], i), *b0 = ROW(b[0], i), *b1 = ROW(b[1], i), *b2 = ROW(b[2], i);
        float *p0 = kept(pulls, stride, i, f, 0) + left, *p1 = kept(pulls, stride, i, f, 1) + left;
        float *p2 = kept(pulls, stride, i, f, 2) + left;
        adjoint_family(n, net->k[f] + (long)i * n, net->l[f] + (long)i * n, x0, x1, x2, x0 + head, x1 + head, x2 + head, b0, b1, b2,
                       b0 + head, b1 + head, b2 + head, p0, p1, p2, sum, sum + stride, sum + 2 * stride, of_k + here, of_l + here, dt);
    }
}

/* g: (3, ...) gradient by the positions; b, next: by the velocities, before and after. */
static void back_row(const Net *net, int i, float *pulls, const float *sum, float *const g[3], float *const b[3], float *const next[3],
                     float dt) {
    const int n = net->n, stride = net->stride, lanes = net->lanes, left = PAD * lanes;
    for (int c = 0; c < 3; c++) {
        float *restrict at = ROW(g[c], i), *restrict to = ROW(next[c], i);
        const float *restrict from = ROW(b[c], i), *restrict s = sum + c * stride;
        for (int j = 0; j < n; j++) {
            at[j] += COMING(c, j) - s[j];
            to[j] = from[j] + dt * at[j];
        }
    }
}

/* After `cloth` with a whole history. g: (3, ...) zeros; b: (2, 3, ...) zeros; of_k, of_l: (F, rows, n) zeros, filled for the loss sum x^2.
   waste: (threads, 2, F, rows, n): where rows that two threads compute are thrown away. */
void cloth_gradient(int rows, int n, const float *k, const float *l, float *x, float *g, float *b, float *of_k, float *of_l, float *waste,
                    float dt, int n_steps, int threads) {
    const Net net = make_net(rows, n, 1, k, l);
    const int stride = net.stride, left = PAD;
    const long plane = (long)(rows + 2) * stride, springs = (long)FAMILIES * rows * n;
    float *last = x + (long)n_steps * 3 * plane;
    for (int c = 0; c < 3; c++)
        for (int i = 0; i < rows; i++)
            for (int j = 0; j < n; j++) {
                const long at = c * plane + (long)i * stride + left + j;
                g[at] = 2 * last[at];
                b[at] = dt * g[at];
            }
#pragma omp parallel num_threads(threads) if (threads > 1)
    {
        const int me = omp_get_thread_num(), begin = rows * me / threads, end = rows * (me + 1) / threads;
        float *pulls = kept_rows(stride), *sum = calloc(3 * stride, sizeof(float)), *thrown = waste + 2 * me * springs;
        for (int t = n_steps - 1; t >= 0; t--) {
            float *a = x + (long)t * 3 * plane, *p = b + ((n_steps - 1 - t) % 2) * 3 * plane, *q = b + ((n_steps - t) % 2) * 3 * plane;
            float *at[3] = {a, a + plane, a + 2 * plane}, *from[3] = {p, p + plane, p + 2 * plane};
            float *to[3] = {q, q + plane, q + 2 * plane}, *grad[3] = {g, g + plane, g + 2 * plane};
            memset(pulls, 0, sizeof(float) * 3 * FAMILIES * 3 * stride);
            for (int i = begin >= 2 ? begin - 2 : 0; i < begin; i++)
                adjoint_row(&net, i, at, from, pulls, sum, thrown, thrown + springs, dt);
            for (int i = begin; i < end; i++) {
                adjoint_row(&net, i, at, from, pulls, sum, of_k, of_l, dt);
                back_row(&net, i, pulls, sum, grad, from, to, dt);
            }
#pragma omp barrier
        }
        free(pulls), free(sum);
    }
}

/* Explicit conduction in a block: temperature (2, nz + 2, ny + 2, nx + 16), in the same shape the conductances at the lower
   node of each axis, zero beyond borders. */
void heat(int nz, int ny, int nx, const float *gx, const float *gy, const float *gz, float *temperature, float dt, int n_steps,
          int threads) {
    const long row = nx + PAD, layer = (ny + 2) * row, whole = (nz + 2) * layer;
#pragma omp parallel num_threads(threads) if (threads > 1)
    for (int t = 0; t < n_steps; t++) {
        const float *restrict old = temperature + (t % 2) * whole;
        float *restrict new = temperature + ((t + 1) % 2) * whole;
#pragma omp for schedule(static)
        for (int z = 1; z <= nz; z++)
            for (int y = 1; y <= ny; y++) {
                const long at = z * layer + y * row + PAD - 1;
                for (long i = at; i < at + nx; i++)
                    new[i] = old[i] + dt * (gx[i] * (old[i + 1] - old[i]) - gx[i - 1] * (old[i] - old[i - 1])
                                            + gy[i] * (old[i + row] - old[i]) - gy[i - row] * (old[i] - old[i - row])
                                            + gz[i] * (old[i + layer] - old[i]) - gz[i - layer] * (old[i] - old[i - layer]));
            }
    }
}
