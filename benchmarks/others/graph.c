/* Graphs of springs by hand: nodes in slices of 16, sorted by degree; every spring computed at both of its ends, so that nothing is
   scattered. Four numbers a node, x y z 0, so that a neighbour is one load; sixteen of them are turned in registers. Positions are read
   from one buffer and written to the next, so that threads meet once a step. */

#include "vectors.h"

#define TINY 1e-30f /* a place that pads names its own node, with k = 0 */

typedef struct {
    v16 x, y, z;
} V3;

#ifdef __AVX512F__
static inline V3 fetch(const float *from, const int *nodes) {
    __m512 r[4];
    for (int q = 0; q < 4; q++) {
        r[q] = _mm512_castps128_ps512(_mm_loadu_ps(from + 4L * nodes[q]));
        r[q] = _mm512_insertf32x4(r[q], _mm_loadu_ps(from + 4L * nodes[q + 4]), 1);
        r[q] = _mm512_insertf32x4(r[q], _mm_loadu_ps(from + 4L * nodes[q + 8]), 2);
        r[q] = _mm512_insertf32x4(r[q], _mm_loadu_ps(from + 4L * nodes[q + 12]), 3);
    }
    const __m512d a = _mm512_castps_pd(_mm512_unpacklo_ps(r[0], r[1])), b = _mm512_castps_pd(_mm512_unpacklo_ps(r[2], r[3]));
    const __m512d c = _mm512_castps_pd(_mm512_unpackhi_ps(r[0], r[1])), d = _mm512_castps_pd(_mm512_unpackhi_ps(r[2], r[3]));
    return (V3){(v16)_mm512_unpacklo_pd(a, b), (v16)_mm512_unpackhi_pd(a, b), (v16)_mm512_unpacklo_pd(c, d)};
}
#else
static inline V3 fetch(const float *from, const int *nodes) {
    V3 out;
    for (int a = 0; a < LANES; a++) {
        const float *node = from + 4L * nodes[a];
        out.x[a] = node[0], out.y[a] = node[1], out.z[a] = node[2];
    }
    return out;
}
#endif

/* Of sixteen nodes in a row. */
static inline V3 own(const float *from) {
    static const int in_order[LANES] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    return fetch(from, in_order);
}

static inline void put(float *to, V3 a) {
    for (int i = 0; i < LANES; i++) to[4 * i] = a.x[i], to[4 * i + 1] = a.y[i], to[4 * i + 2] = a.z[i];
}

static inline V3 minus(V3 a, V3 b) { return (V3){a.x - b.x, a.y - b.y, a.z - b.z}; }
static inline V3 plus(V3 a, v16 w, V3 b) { return (V3){a.x + w * b.x, a.y + w * b.y, a.z + w * b.z}; }
static inline v16 dot(V3 a, V3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

static inline v16 at_least(v16 a, float low) {
    for (int i = 0; i < LANES; i++) a[i] = a[i] > low ? a[i] : low;
    return a;
}

/* x: (history, n, 4); v: (n, 4); heads, k, l: entries, slice by slice, 16 at a time. Step t writes x[(t + 1) % history]. */
void graph(int n, const int *starts, const int *heads, const float *k, const float *l, float *x, float *v, float dt, int n_steps,
           int history, int threads) {
    const long n_slices = n / LANES;
    const v16 step = dt + (v16){0};
    Meeting meeting = {0, 0};
#pragma omp parallel num_threads(threads) if (threads > 1)
    {
        const int me = omp_get_thread_num(), begin = n_slices * me / threads, end = n_slices * (me + 1) / threads;
        for (int t = 0; t < n_steps; t++) {
            const float *from = x + (t % history) * 4L * n;
            float *to = x + ((t + 1) % history) * 4L * n;
            for (int s = begin; s < end; s++) {
                const long mine = 4L * LANES * s;
                const V3 here = own(from + mine);
                V3 force = {{0}, {0}, {0}};
                for (int e = starts[s]; e < starts[s + 1]; e += LANES) {
                    const V3 d = minus(fetch(from, heads + e), here);
                    force = plus(force, load(k + e) * (1.0f - load(l + e) * inverse_root(at_least(dot(d, d), TINY))), d);
                }
                const V3 speed = plus(own(v + mine), step, force);
                put(v + mine, speed);
                put(to + mine, plus(here, step, speed));
            }
            meet(&meeting, threads);
        }
    }
}

/* After `graph` with a whole history: the gradient of the sum of squared last positions. g: (n, 4) and b: (2, n, 4) zeros; of_k, of_l:
   entries, zeros, filled; both ends of a spring find the same. */
void graph_gradient(int n, const int *starts, const int *heads, const float *k, const float *l, const float *x, float *g, float *b,
                    float *of_k, float *of_l, float dt, int n_steps, int threads) {
    const long n_slices = n / LANES;
    const v16 step = dt + (v16){0};
    for (long i = 0; i < 4L * n; i++) {
        g[i] = 2 * x[n_steps * 4L * n + i];
        b[i] = dt * g[i];
    }
    Meeting meeting = {0, 0};
#pragma omp parallel num_threads(threads) if (threads > 1)
    {
        const int me = omp_get_thread_num(), begin = n_slices * me / threads, end = n_slices * (me + 1) / threads;
        for (int t = n_steps - 1; t >= 0; t--) {
            const float *at = x + t * 4L * n, *from = b + ((n_steps - 1 - t) % 2) * 4L * n;
            float *to = b + ((n_steps - t) % 2) * 4L * n;
            for (int s = begin; s < end; s++) {
                const long mine = 4L * LANES * s;
                const V3 here = own(at + mine), b_here = own(from + mine);
                V3 sum = {{0}, {0}, {0}};
                for (int e = starts[s]; e < starts[s + 1]; e += LANES) {
                    const V3 d = minus(fetch(at, heads + e), here), a = minus(b_here, fetch(from, heads + e));
                    const v16 ke = load(k + e), le = load(l + e), r = inverse_root(at_least(dot(d, d), TINY)), along = step * dot(d, a);
                    const v16 stretch = 1.0f - le * r;
                    sum = plus(plus(sum, step * ke * stretch, a), ke * le * r * r * r * along, d);
                    store(of_k + e, load(of_k + e) + stretch * along);
                    store(of_l + e, load(of_l + e) - ke * r * along);
                }
                const V3 of_x = minus(own(g + mine), sum);
                put(g + mine, of_x);
                put(to + mine, plus(b_here, step, of_x));
            }
            meet(&meeting, threads);
        }
    }
}
