/* Sixteen numbers at a time, by the compiler's vector types: AVX-512 registers where the machine has them, parts where not. And where
   threads meet. */

#include <math.h>
#include <sched.h>
#include <string.h>
#ifdef __AVX512F__
#include <immintrin.h>
#endif
#ifdef _OPENMP
#include <omp.h>
#else
#define omp_get_thread_num() 0
#endif

#define LANES 16
typedef float v16 __attribute__((vector_size(64)));

static inline v16 load(const float *from) {
    v16 a;
    memcpy(&a, from, sizeof a);
    return a;
}

static inline void store(float *to, v16 a) { memcpy(to, &a, sizeof a); }

/* 1 / sqrt(q): with -ffast-math an estimate and one step of Newton's method. */
static inline v16 inverse_root(v16 q) {
    v16 r;
    for (int a = 0; a < LANES; a++) r[a] = 1.0f / sqrtf(q[a]);
    return r;
}

/* A barrier. OpenMP's own keeps its processor while it waits: milliseconds where another program has the other one. */
typedef struct {
    int arrived, round;
} Meeting;

static inline void meet(Meeting *m, int threads) {
    if (threads == 1) return;
    const int round = __atomic_load_n(&m->round, __ATOMIC_ACQUIRE);
    if (__atomic_add_fetch(&m->arrived, 1, __ATOMIC_ACQ_REL) == threads) {
        __atomic_store_n(&m->arrived, 0, __ATOMIC_RELAXED);
        __atomic_store_n(&m->round, round + 1, __ATOMIC_RELEASE);
        return;
    }
    for (int spins = 0; __atomic_load_n(&m->round, __ATOMIC_ACQUIRE) == round; spins++)
        if (spins > 2000) sched_yield();
}
