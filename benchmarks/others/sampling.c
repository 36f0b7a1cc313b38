/* Bilinear samples of a picture by hand, and the slopes of the sum of their squares by each point. */

#ifdef _OPENMP
#include <omp.h>
#endif

static inline int cell(float a, int n) {
    const int i = (int)a;
    return i < 0 ? 0 : i > n - 2 ? n - 2 : i;
}

static inline float inside(float a, int n) { return a < 0 ? 0 : a > n - 1 ? n - 1 : a; }

void samples(int ny, int nx, const float *restrict image, int n, const float *restrict x, const float *restrict y, float *restrict out,
             int threads) {
#pragma omp parallel for simd num_threads(threads) schedule(static)
    for (int p = 0; p < n; p++) {
        const float u = inside(x[p], nx), v = inside(y[p], ny);
        const int i = cell(u, nx), j = cell(v, ny), at = j * nx + i;
        const float tx = u - i, ty = v - j;
        const float low = image[at] + tx * (image[at + 1] - image[at]), high = image[at + nx] + tx * (image[at + nx + 1] - image[at + nx]);
        out[p] = low + ty * (high - low);
    }
}

/* out: (2, n). Outside the outermost pixels the slope is zero. */
void slopes(int ny, int nx, const float *restrict image, int n, const float *restrict x, const float *restrict y, float *restrict out,
            int threads) {
#pragma omp parallel for simd num_threads(threads) schedule(static)
    for (int p = 0; p < n; p++) {
        const float u = inside(x[p], nx), v = inside(y[p], ny);
        const int i = cell(u, nx), j = cell(v, ny), at = j * nx + i;
        const float tx = u - i, ty = v - j;
        const float down = image[at + 1] - image[at], up = image[at + nx + 1] - image[at + nx];
        const float low = image[at] + tx * down, high = image[at + nx] + tx * up;
        const float twice = 2 * (low + ty * (high - low));
        out[p] = u == x[p] ? twice * (down + ty * (up - down)) : 0;
        out[n + p] = v == y[p] ? twice * (high - low) : 0;
    }
}
