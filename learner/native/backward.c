/*
 * The LQG backward pass along sub-trajectories, and the forward pass that predicts its gain: what learner/lqg.py states.
 *
 * The matrices are small (39 states, 24 actions), so that calls of a general library cost more than the arithmetic; here
 * they stay in the first cache. Every sum has one order and every term is added by a fused multiplication: the same bits
 * on every processor that has it (since 2013).
 */
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <float.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#pragma GCC optimize("fp-contract=fast", "no-tree-loop-distribute-patterns")
#define ALL_KINDS __attribute__((target_clones("avx512f", "fma", "default")))
#define INLINE static inline __attribute__((always_inline))

enum { ROWS = 6, COLUMNS = 16 };

/*
 * Matrices are row-major with rows of a multiple of COLUMNS entries, of which those beyond the matrix may hold anything
 * finite. Products are made by ROWS rows at once, so that matrices have up to ROWS - 1 more rows than they need.
 */
typedef Py_ssize_t size; /* of an index that is multiplied: quicker than int where ints may wrap, as in Python's builds */
typedef void product(float *C, size c, const float *a, size row, size column, const float *B, size b, size inner,
                     size width, size first, size end, int upper, int subtract);

/*
 * C <- A B or, if `subtract`, C - A B for the rows first..end and `width` columns of C, where a(i, k) = a[i * row + k *
 * column] and the rows of C and B lie c and b entries apart; if `upper`, only the tiles that reach the diagonal or lie
 * above it.
 */
#define PRODUCT(name, isa, vectors, lanes)                                                                             \
    __attribute__((target(isa))) static void name(float *C, size c, const float *a, size row, size column,             \
                                                  const float *B, size b, size inner, size width, size first,          \
                                                  size end, int upper, int subtract) {                                 \
        typedef float vector __attribute__((vector_size(lanes * sizeof(float)), aligned(sizeof(float))));              \
        for (size i = first; i < end; i += ROWS)                                                                       \
            for (size at = upper ? i / COLUMNS * COLUMNS : 0; at < width; at += vectors * lanes) {                     \
                vector sum[ROWS][vectors] = {{{0}}};                                                                   \
                for (size k = 0; k < inner; k++) {                                                                     \
                    const vector *from = (const vector *)(B + k * b + at);                                             \
                    for (size r = 0; r < ROWS; r++)                                                                    \
                        for (size v = 0; v < vectors; v++) sum[r][v] += a[(i + r) * row + k * column] * from[v];       \
                }                                                                                                      \
                for (size r = 0; r < ROWS; r++)                                                                        \
                    for (size v = 0; v < vectors; v++) {                                                               \
                        vector *to = (vector *)(C + (i + r) * c + at) + v;                                             \
                        *to = subtract ? *to - sum[r][v] : sum[r][v];                                                  \
                    }                                                                                                  \
            }                                                                                                          \
    }

PRODUCT(product_16, "avx512f", 1, 16)
PRODUCT(product_8, "fma", 2, 8)
PRODUCT(product_4, "sse2", 1, 4)

/* Entries of a row for n. */
static size padded(size n) { return (n + COLUMNS - 1) / COLUMNS * COLUMNS; }

static product *multiply; /* the one for this processor */

/* to <- to - factor from, `width` entries from the block of COLUMNS on in which `first` lies. */
INLINE void subtract_row(float *restrict to, float factor, const float *restrict from, size first, size width) {
    for (size at = first / COLUMNS * COLUMNS; at < width; at += COLUMNS)
        for (size j = 0; j < COLUMNS; j++) to[at + j] -= factor * from[at + j];
}

/* [M A] <- [U U^-T A] for M [n, n], of which only the upper half counts, M = U'U. 0 if M is not positive definite. */
ALL_KINDS static int eliminate(float *M, size stride, size n, size width) {
    for (size first = 0, next; first < n; first = next) {
        next = first + ROWS < n ? first + ROWS : n;
        for (size k = first; k < next; k++) {
            float *restrict pivot = M + k * stride;
            if (!(pivot[k] > 0)) return 0;
            const float scale = 1 / sqrtf(pivot[k]);
            for (size j = k / COLUMNS * COLUMNS; j < width; j++) pivot[j] *= scale;
            for (size i = k + 1; i < next; i++) subtract_row(M + i * stride, pivot[i], pivot, i, width);
        }
        const float *rows = M + first * stride;
        multiply(M, stride, rows, 1, stride, rows, stride, next - first, width, next, n, 1, 1);
    }
    return 1;
}

/* Y <- U^-1 Y with Y [n, width] and U the upper half of rows of `stride` entries. */
ALL_KINDS static void substitute(float *Y, size width, const float *U, size n, size stride) {
    for (size next = n, first; next > 0; next = first) {
        first = (next - 1) / ROWS * ROWS;
        for (size k = next - 1; k >= first; k--) {
            float *restrict solved = Y + k * width;
            const float scale = 1 / U[k * stride + k];
            for (size j = 0; j < width; j++) solved[j] *= scale;
            for (size i = first; i < k; i++) subtract_row(Y + i * width, U[i * stride + k], solved, 0, width);
        }
        multiply(Y, width, U + first, stride, 1, Y + first * width, width, next - first, width, 0, first, 0, 1);
    }
}

/* [L l] [n, width] <- the triangle R [nx, width] with the same |L dx + l|^2 but for a constant (Householder). */
ALL_KINDS static void compress(float *L, size n, size nx, size width, float *u, float *along) {
    for (size k = 0; k < nx; k++) {
        float square = 0;
        for (size i = k; i < n; i++) {
            u[i] = L[i * width + k];
            square = fmaf(u[i], u[i], square);
        }
        if (square < FLT_MIN) continue; /* nothing there, as where nothing depends on an entry of x */
        const float diagonal = -copysignf(sqrtf(square), u[k]), scale = 1 / fmaf(-diagonal, u[k], square);
        u[k] -= diagonal;
        memset(along, 0, sizeof(float) * width);
        for (size i = k; i < n; i++) subtract_row(along, -u[i], L + i * width, k, width);
        for (size i = k; i < n; i++) {
            subtract_row(L + i * width, u[i] * scale, along, k, width);
            L[i * width + k] = i == k ? diagonal : 0;
        }
    }
}

/* What is given and found along one sub-trajectory; all arrays contiguous, shapes in learner/lqg.py. */
struct problem {
    const float *F, *R_inverse, *P, *residual, *deviation;
    const int64_t *model;
    float *K, *k, *change;
    size length;
};

/* Sizes and memory: n rows of [L l] at most; rows of F, of [L l] and of M have F_width, width and n_width entries. */
struct work {
    size nx, nu, cost_n, n, F_width, width, n_width;
    float *root, *L, *M, *W, *Z, *gains, *z, *u; /* W = R^-1 Gu', Z = M^-1 [Gx g] */
};

/* Rows of [D r] below the n rows of [L l]; returns how many there are then. */
static size add_cost(const struct work *w, size n, const float *residual) {
    for (size i = 0; i < w->cost_n; i++) {
        float *row = w->L + (n + i) * w->width;
        memcpy(row, w->root + i * w->width, sizeof(float) * w->width);
        row[w->nx] = residual[i];
    }
    return n + w->cost_n;
}

/* Ask for n entries that will be needed soon: tables of models are larger than a cache. */
INLINE void fetch(const float *from, size n) {
    for (size i = 0; i < n; i += COLUMNS) __builtin_prefetch(from + i);
}

/* The gains [P - K, -dev - k] of step t [nu, width]: e = -(them) [dx 1]. */
INLINE float *gains_at(const struct work *w, size t) { return w->gains + t * (w->nu + ROWS) * w->width; }

ALL_KINDS static int backward(const struct problem *p, const struct work *w) {
    const size nx = w->nx, nu = w->nu, width = w->width;
    float *L = w->L, *M = w->M, *W = w->W, *Z = w->Z;
    size n = add_cost(w, 0, p->residual + (p->length - 1) * w->cost_n);
    for (size t = p->length - 1;; t--) {
        const size m = p->model[t], n_width = padded(n), stride = n_width + w->F_width;
        const float *R_inverse = p->R_inverse + m * nu, *deviation = p->deviation + t * nu, *P = p->P + m * nu * nx;
        if (t > 0) {
            fetch(p->F + p->model[t - 1] * nx * w->F_width, nx * w->F_width);
            fetch(p->P + p->model[t - 1] * nu * nx, nu * nx);
        }
        float *G = M + n_width; /* [M G], G = [Gx g Gu] */
        multiply(G, stride, L, width, 1, p->F + m * nx * w->F_width, w->F_width, nx, w->F_width, 0, n, 0, 0);
        for (size i = 0; i < n; i++) {
            const float *Gu = G + i * stride + nx + 1;
            float g = L[i * width + nx];
            for (size j = 0; j < nu; j++) {
                W[j * n_width + i] = R_inverse[j] * Gu[j];
                g = fmaf(-Gu[j], deviation[j], g);
            }
            G[i * stride + nx] = g;
        }
        multiply(M, stride, G + nx + 1, stride, 1, W, n_width, nu, n_width, 0, n, 1, 0);
        for (size i = 0; i < n; i++) M[i * stride + i] += 1;
        if (!eliminate(M, stride, n, n_width + width)) return 0;
        for (size i = 0; i < n; i++) {
            memcpy(L + i * width, G + i * stride, sizeof(float) * width);
            memcpy(Z + i * width, G + i * stride, sizeof(float) * width);
        }
        substitute(Z, width, M, n, stride);
        float *gains = gains_at(w, t);
        multiply(gains, width, W, n_width, 1, Z, width, n, width, 0, nu, 0, 0);
        for (size i = 0; i < nu; i++) {
            const float *restrict from = gains + i * width, *restrict P_i = P + i * nx;
            float *restrict K = p->K + (t * nu + i) * nx;
            for (size j = 0; j < nx; j++) K[j] = P_i[j] - from[j];
            p->k[t * nu + i] = -from[nx] - deviation[i];
        }
        if (t == 0) return 1;
        if (n > nx) {
            compress(L, n, nx, width, w->u, w->z);
            n = nx;
        }
        n = add_cost(w, n, p->residual + (t - 1) * w->cost_n);
    }
}

/* n is a multiple of PARTS. */
INLINE float dot(const float *a, const float *b, size n) {
    enum { PARTS = 8 };
    float sum[PARTS] = {0}, total = 0;
    for (size i = 0; i < n; i += PARTS)
        for (size j = 0; j < PARTS; j++) sum[j] += a[i + j] * b[i + j];
    for (size j = 0; j < PARTS; j++) total += sum[j];
    return total;
}

/* What the improved policy changes in the running cost, by the models. */
ALL_KINDS static void forward(const struct problem *p, const struct work *w) {
    const size nx = w->nx, nu = w->nu, width = w->width;
    float *z = w->z, *next = w->u; /* z = [dx 1 e 0], next = e, then dx */
    memset(z, 0, sizeof(float) * w->F_width);
    z[nx] = 1;
    for (size t = 0; t < p->length; t++) {
        const float *F = p->F + p->model[t] * nx * w->F_width, *deviation = p->deviation + t * nu;
        const float *residual = p->residual + t * w->cost_n, *gains = gains_at(w, t);
        memset(z + nx + 1, 0, sizeof(float) * nu);
        for (size i = 0; i < nu; i++) next[i] = -dot(gains + i * width, z, width) - deviation[i];
        memcpy(z + nx + 1, next, sizeof(float) * nu);
        for (size i = 0; i < nx; i++) next[i] = dot(F + i * w->F_width, z, w->F_width);
        memcpy(z, next, sizeof(float) * nx);
        float change = 0;
        for (size i = 0; i < w->cost_n; i++) {
            const float more = dot(w->root + i * width, z, width);
            change = fmaf(more, fmaf(more, 0.5f, residual[i]), change);
        }
        p->change[t] = change;
    }
}

enum { F, R_INVERSE, P, MODEL, RESIDUAL, ROOT, DEVIATION, K, SMALL_K, CHANGE, ARRAYS };
static const int dimensions[ARRAYS] = {3, 2, 3, 2, 3, 2, 3, 4, 3, 2};

/* Whether the shapes of all arrays follow from the numbers b, T, nx, nu, of rows of D and of models. */
static int fits(const Py_buffer *a, Py_ssize_t b, Py_ssize_t T, Py_ssize_t nx, Py_ssize_t nu, Py_ssize_t cost_n,
                Py_ssize_t models) {
    const Py_ssize_t F_width = a[F].shape[2];
    const Py_ssize_t expected[ARRAYS][4] = {
        {models, nx, F_width}, {models, nu},  {models, nu, nx}, {b, T},     {b, T, cost_n},
        {cost_n, nx},          {b, T, nu},    {b, T, nu, nx},   {b, T, nu}, {b, T},
    };
    for (int i = 0; i < ARRAYS; i++)
        for (int d = 0; d < dimensions[i]; d++)
            if (a[i].shape[d] != expected[i][d]) return 0;
    const int64_t *model = a[MODEL].buf;
    for (Py_ssize_t i = 0; i < b * T; i++)
        if (model[i] < 0 || model[i] >= models) return 0;
    return nx > 0 && nu > 0 && T > 0 && cost_n > 0 && F_width % COLUMNS == 0 && F_width > nx + nu;
}

/* All sub-trajectories one after the other; returns the first that could not be solved, -1 if there is none. */
static Py_ssize_t run(const Py_buffer *a, const struct work *w) {
    const size b = a[RESIDUAL].shape[0], T = a[RESIDUAL].shape[1], nx = w->nx, nu = w->nu;
    for (size i = 0; i < b; i++) {
        const struct problem problem = {
            .F = a[F].buf,
            .R_inverse = a[R_INVERSE].buf,
            .P = a[P].buf,
            .residual = (float *)a[RESIDUAL].buf + i * T * w->cost_n,
            .deviation = (float *)a[DEVIATION].buf + i * T * nu,
            .model = (int64_t *)a[MODEL].buf + i * T,
            .K = (float *)a[K].buf + i * T * nu * nx,
            .k = (float *)a[SMALL_K].buf + i * T * nu,
            .change = (float *)a[CHANGE].buf + i * T,
            .length = T,
        };
        if (!backward(&problem, w)) return i;
        forward(&problem, w);
    }
    return -1;
}

static PyObject *solve_all(const Py_buffer *a) {
    const size nx = a[F].shape[1], nu = a[DEVIATION].shape[2], cost_n = a[ROOT].shape[0], T = a[MODEL].shape[1];
    struct work w = {.nx = nx, .nu = nu, .cost_n = cost_n, .n = (nx > cost_n ? nx : cost_n) + cost_n};
    w.F_width = a[F].shape[2], w.width = padded(nx + 1), w.n_width = padded(w.n);
    const struct {
        float **place;
        size n;
    } parts[] = {
        {&w.root, cost_n * w.width},
        {&w.L, (w.n + ROWS) * w.width},
        {&w.M, (w.n + ROWS) * (w.n_width + w.F_width)},
        {&w.W, (nu + ROWS) * w.n_width},
        {&w.Z, (w.n + ROWS) * w.width},
        {&w.gains, T * (nu + ROWS) * w.width},
        {&w.z, w.F_width},
        {&w.u, padded(w.n + nu)},
    };
    enum { PARTS = sizeof parts / sizeof *parts };
    size total = 0;
    for (int i = 0; i < PARTS; i++) total += parts[i].n;
    float *memory = calloc(total, sizeof(float));
    if (!memory) return PyErr_NoMemory();
    for (int i = PARTS - 1; i >= 0; i--) *parts[i].place = memory + (total -= parts[i].n);
    for (size i = 0; i < cost_n; i++) memcpy(w.root + i * w.width, (float *)a[ROOT].buf + i * nx, sizeof(float) * nx);
    Py_ssize_t failed;
    Py_BEGIN_ALLOW_THREADS;
    failed = run(a, &w);
    Py_END_ALLOW_THREADS;
    free(memory);
    return PyLong_FromSsize_t(failed);
}

/*
 * improve(F, R_inverse, P, model, residual, root, deviation, K, k, change): contiguous arrays of float32, `model` of
 * int64; the last three are written. Returns the first sub-trajectory that could not be solved, -1 if there is none.
 */
static PyObject *improve(PyObject *self, PyObject *const *arguments, Py_ssize_t n) {
    (void)self;
    Py_buffer a[ARRAYS];
    int opened = 0, plain = n == ARRAYS;
    for (; plain && opened < ARRAYS; opened++) {
        const int flags = PyBUF_FORMAT | (opened < K ? PyBUF_C_CONTIGUOUS : PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE);
        if (PyObject_GetBuffer(arguments[opened], &a[opened], flags)) break;
        plain = strcmp(a[opened].format, opened == MODEL ? "l" : "f") == 0 && a[opened].ndim == dimensions[opened];
    }
    PyObject *result = NULL;
    if (plain && opened == ARRAYS &&
        fits(a, a[MODEL].shape[0], a[MODEL].shape[1], a[F].shape[1], a[DEVIATION].shape[2], a[ROOT].shape[0],
             a[F].shape[0]))
        result = solve_all(a);
    else if (!PyErr_Occurred())
        PyErr_SetString(PyExc_ValueError, "improve: arrays of other types or shapes");
    while (opened > 0) PyBuffer_Release(&a[--opened]);
    return result;
}

static PyMethodDef methods[] = {
    {"improve", (PyCFunction)(void (*)(void))improve, METH_FASTCALL, "Solve sub-trajectories."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef module = {PyModuleDef_HEAD_INIT, "_backward", NULL, -1, methods, NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__backward(void) {
    multiply = __builtin_cpu_supports("avx512f") ? product_16 : __builtin_cpu_supports("fma") ? product_8 : product_4;
    return PyModule_Create(&module);
}
