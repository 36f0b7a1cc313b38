/* Graphs of springs by hand: nodes in slices of 16, sorted by degree; every spring computed at both of its ends, so that nothing is
   scattered. Positions are read from one buffer and written to the next, so that threads meet once a step. */

#include <math.h>
#include <string.h>
#ifdef _OPENMP
#include <omp.h>
#else
#define omp_get_thread_num() 0
#endif

#define LANES 16
#define TINY 1e-30f /* a place that pads names its own node, with k = 0 */

/* x: (history, 3, n); v: (3, n); heads, k, l: entries, slice by slice, 16 at a time. */
void graph(int n, int n_slices, const int *starts, const int *heads, const float *k, const float *l, float *x, float *v, float dt,
           int n_steps, int history, int threads) {
#pragma omp parallel num_threads(threads) if (threads > 1)
    {
        const int me = omp_get_thread_num();
        const int begin = (long)n_slices * me / threads, end = (long)n_slices * (me + 1) / threads;
        for (int t = 0; t < n_steps; t++) {
            const float *restrict x0 = x + (long)(t % history) * 3 * n, *restrict x1 = x0 + n, *restrict x2 = x1 + n;
            float *restrict y0 = x + (long)((t + 1) % history) * 3 * n, *restrict y1 = y0 + n, *restrict y2 = y1 + n;
            float *restrict v0 = v, *restrict v1 = v + n, *restrict v2 = v + 2 * n;
            for (int s = begin; s < end; s++) {
                float f0[LANES] = {0}, f1[LANES] = {0}, f2[LANES] = {0};
                const int at = s * LANES;
                for (int e = starts[s]; e < starts[s + 1]; e += LANES) {
#pragma GCC ivdep
                    for (int a = 0; a < LANES; a++) {
                        const int j = heads[e + a];
                        const float d0 = x0[j] - x0[at + a], d1 = x1[j] - x1[at + a], d2 = x2[j] - x2[at + a];
                        const float w = k[e + a] * (1.0f - l[e + a] / sqrtf(fmaxf(d0 * d0 + d1 * d1 + d2 * d2, TINY)));
                        f0[a] += w * d0, f1[a] += w * d1, f2[a] += w * d2;
                    }
                }
                for (int a = at; a < at + LANES; a++) {
                    v0[a] += dt * f0[a - at], v1[a] += dt * f1[a - at], v2[a] += dt * f2[a - at];
                    y0[a] = x0[a] + dt * v0[a], y1[a] = x1[a] + dt * v1[a], y2[a] = x2[a] + dt * v2[a];
                }
            }
#pragma omp barrier
        }
    }
}

/* After `graph` with a whole history. g: (3, n) and b: (2, 3, n) zeros; of_k, of_l: entries, zeros, filled for the loss sum x^2. */
void graph_gradient(int n, int n_slices, const int *starts, const int *heads, const float *k, const float *l, const float *x, float *g,
                    float *b, float *of_k, float *of_l, float dt, int n_steps, int threads) {
    for (long i = 0; i < 3L * n; i++) {
        g[i] = 2 * x[(long)n_steps * 3 * n + i];
        b[i] = dt * g[i];
    }
#pragma omp parallel num_threads(threads) if (threads > 1)
    {
        const int me = omp_get_thread_num();
        const int begin = (long)n_slices * me / threads, end = (long)n_slices * (me + 1) / threads;
        for (int t = n_steps - 1; t >= 0; t--) {
            const float *restrict x0 = x + (long)t * 3 * n, *restrict x1 = x0 + n, *restrict x2 = x1 + n;
            const float *restrict b0 = b + ((n_steps - 1 - t) % 2) * 3L * n, *restrict b1 = b0 + n, *restrict b2 = b1 + n;
            float *restrict c0 = b + ((n_steps - t) % 2) * 3L * n, *restrict c1 = c0 + n, *restrict c2 = c1 + n;
            float *restrict g0 = g, *restrict g1 = g + n, *restrict g2 = g + 2 * n;
            for (int s = begin; s < end; s++) {
                float f0[LANES] = {0}, f1[LANES] = {0}, f2[LANES] = {0};
                const int at = s * LANES;
                for (int e = starts[s]; e < starts[s + 1]; e += LANES) {
#pragma GCC ivdep
                    for (int a = 0; a < LANES; a++) {
                        const int j = heads[e + a];
                        const float d0 = x0[j] - x0[at + a], d1 = x1[j] - x1[at + a], d2 = x2[j] - x2[at + a];
                        const float a0 = dt * (b0[at + a] - b0[j]), a1 = dt * (b1[at + a] - b1[j]), a2 = dt * (b2[at + a] - b2[j]);
                        const float r = 1.0f / sqrtf(fmaxf(d0 * d0 + d1 * d1 + d2 * d2, TINY)), along = d0 * a0 + d1 * a1 + d2 * a2;
                        const float stretch = 1.0f - l[e + a] * r, w = k[e + a] * stretch;
                        const float turn = k[e + a] * l[e + a] * r * r * r * along;
                        f0[a] += w * a0 + turn * d0, f1[a] += w * a1 + turn * d1, f2[a] += w * a2 + turn * d2;
                        of_k[e + a] += stretch * along;
                        of_l[e + a] -= k[e + a] * r * along;
                    }
                }
                for (int a = at; a < at + LANES; a++) {
                    g0[a] -= f0[a - at], g1[a] -= f1[a - at], g2[a] -= f2[a - at];
                    c0[a] = b0[a] + dt * g0[a], c1[a] = b1[a] + dt * g1[a], c2[a] = b2[a] + dt * g2[a];
                }
            }
#pragma omp barrier
        }
    }
}
