/*
 * The LQG backward pass along sub-trajectories, and the forward pass that predicts its gain: what learner/lqg.py states.
 *
 * The matrices are small (39 states, 24 actions), so that calls of a general library cost more than the arithmetic; here
 * they stay in the first cache. Every sum has one order and every term is added by a fused multiplication: the same bits
 * on every processor that has it (since 2013).
 */
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <math.h>
#include <stdlib.h>
#include <string.h>

#pragma GCC optimize("fp-contract=fast", "no-tree-loop-distribute-patterns")
#define ALL_KINDS __attribute__((target_clones("avx512f", "fma", "default")))

enum { ROWS = 8, COLUMNS = 16 };

/*
 * A time step works on one symmetric matrix, the quadratic form of (du, dx, 1) to be least over du:
 *
 *     Q = [Quu Qux qu]
 *         [ .  Qxx qx]
 *
 * The elimination of du leaves [V v] in the place of [Qxx qx]. Matrices are row-major, their rows have `width` entries,
 * a multiple of COLUMNS. Of Q only what lies on or above the diagonal counts, of V all. Products are made by ROWS rows at
 * once, so that matrices have up to ROWS - 1 more rows than they need.
 */
struct work {
    int nx, nu, nz, width, gains_width, acting; /* acting: leading entries of x with a row of H that is not zero */
    float *F, *VF, *Q, *gains;                  /* F = [Fu Fx 0; 0 0 1] */
    float *dz, *dx;
};

/*
 * C <- A B or, if `subtract`, C - A B for the rows first..end of C, where a(i, k) = a[i * row + k * column] and B is
 * [inner, width]; if `upper`, only the tiles that reach the diagonal or lie above it.
 */
typedef Py_ssize_t size; /* of an index that is multiplied: quicker than int where ints may wrap, as in Python's builds */
typedef void product(float *C, const float *a, size row, size column, const float *B, size inner, size width, size first,
                     size end, int upper, int subtract);

#define PRODUCT(name, isa, lanes)                                                                                      \
    __attribute__((target(isa))) static void name(float *C, const float *a, size row, size column, const float *B,     \
                                                  size inner, size width, size first, size end, int upper,             \
                                                  int subtract) {                                                      \
        typedef float vector __attribute__((vector_size(lanes * sizeof(float))));                                      \
        for (size i = first; i < end; i += ROWS)                                                                       \
            for (size at = upper ? i / COLUMNS * COLUMNS : 0; at < width; at += lanes) {                               \
                vector sum[ROWS] = {{0}};                                                                              \
                for (size k = 0; k < inner; k++)                                                                       \
                    for (size r = 0; r < ROWS; r++)                                                                    \
                        sum[r] += a[(i + r) * row + k * column] * *(const vector *)(B + k * width + at);               \
                for (size r = 0; r < ROWS; r++) {                                                                      \
                    vector *to = (vector *)(C + (i + r) * width + at);                                                 \
                    *to = subtract ? *to - sum[r] : sum[r];                                                            \
                }                                                                                                      \
            }                                                                                                          \
    }

PRODUCT(product_16, "avx512f", 16)
PRODUCT(product_8, "fma", 8)
PRODUCT(product_4, "sse2", 4)

static product *multiply; /* the one for this processor */

/* to <- to - factor from, from entry `first` of `width` on. */
static inline __attribute__((always_inline)) void subtract_row(float *restrict to, float factor,
                                                               const float *restrict from, size first, size width) {
    for (size at = first / COLUMNS * COLUMNS; at < width; at += COLUMNS)
        for (size j = 0; j < COLUMNS; j++) to[at + j] -= factor * from[at + j];
}

/*
 * Eliminates the first n unknowns from rows 0..end of Q: the first n rows become U^-T [A B], where A = U'U is their
 * square part, and the others lose B'A^-1 B. Returns 0 if A is not positive definite.
 */
ALL_KINDS static int eliminate(float *Q, size n, size end, size width) {
    for (size first = 0, next; first < n; first = next) {
        next = first + ROWS < n ? first + ROWS : n;
        for (size k = first; k < next; k++) {
            float *restrict pivot = Q + k * width;
            if (!(pivot[k] > 0)) return 0;
            const float scale = 1 / sqrtf(pivot[k]);
            for (size j = k / COLUMNS * COLUMNS; j < width; j++) pivot[j] *= scale;
            for (size i = k + 1; i < next; i++) subtract_row(Q + i * width, pivot[i], pivot, i, width);
        }
        const float *rows = Q + first * width;
        multiply(Q, rows, 1, width, rows, next - first, width, next, end, 1, 1);
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
        multiply(Y, U + first, stride, 1, Y + first * width, next - first, width, 0, first, 0, 1);
    }
}

/* What is given and found along one sub-trajectory; all arrays contiguous, shapes in learner/lqg.py. */
struct problem {
    const float *F, *precision, *precision_P, *P_precision_P, *gradient, *hessian, *deviation;
    const int64_t *model;
    float *K, *k, *change;
    int length;
};

ALL_KINDS static int backward(const struct problem *p, const struct work *w) {
    const size nx = w->nx, nu = w->nu, nz = w->nz, stride = w->width;
    float *F = w->F, *Q = w->Q, *Qxx = Q + nu * (stride + 1), *gains = w->gains;
    for (size i = 0; i < nx; i++) {
        memcpy(Qxx + i * stride, p->hessian + i * nx, sizeof(float) * nx);
        Qxx[i * stride + nx] = p->gradient[(size_t)(p->length - 1) * nx + i];
    }
    for (int t = p->length - 1; t >= 0; t--) {
        const size_t m = (size_t)p->model[t];
        const float *precision = p->precision + m * nu, *precision_P = p->precision_P + m * nu * nx;
        const float *both = p->P_precision_P + m * nx * nx, *deviation = p->deviation + (size_t)t * nu;
        for (size i = 0; i < nx; i++) {
            const float *restrict from = p->F + (m * nx + i) * nz;
            float *restrict to = F + i * stride;
            for (size j = 0; j < nu; j++) to[j] = from[nx + j];
            for (size j = 0; j < nx; j++) to[nu + j] = from[j];
        }
        multiply(w->VF, Qxx, stride, 1, w->F, nx + 1, stride, 0, nx, 0, 0); /* [V v] F */
        multiply(Q, F, 1, stride, w->VF, nx, stride, 0, t ? nz : nu, 1, 0); /* F' of it; at last only rows of du */
        float *restrict v = w->dx;
        for (size i = 0; i < nx; i++) v[i] = t ? p->gradient[(size_t)(t - 1) * nx + i] : 0;
        for (size i = 0; i < nu; i++) {
            float *restrict row = Q + i * stride, *restrict Qux = row + nu;
            const float *restrict precision_P_i = precision_P + i * nx;
            const float weight = deviation[i];
            row[i] += precision[i];
            for (size j = 0; j < nx; j++) {
                Qux[j] -= precision_P_i[j];
                v[j] -= weight * precision_P_i[j];
            }
            row[nz] += precision[i] * weight;
        }
        for (size i = 0; t && i < nx; i++) {
            float *restrict row = Qxx + i * stride;
            const float *restrict both_i = both + i * nx, *restrict hessian = p->hessian + i * nx;
            for (size j = i; j < nx; j++) row[j] += both_i[j] + hessian[j];
            row[nx] += v[i];
        }
        if (!eliminate(Q, nu, t ? nz : nu, stride)) return 0;
        for (size i = 0; i < nu; i++) memcpy(gains + i * w->gains_width, Q + i * stride + nu, sizeof(float) * (nx + 1));
        substitute(gains, w->gains_width, Q, nu, stride);
        for (size i = 0; i < nu; i++) {
            const float *from = gains + i * w->gains_width;
            float *restrict K = p->K + ((size_t)t * nu + i) * nx;
            for (size j = 0; j < nx; j++) K[j] = -from[j];
            p->k[(size_t)t * nu + i] = -from[nx];
        }
        if (t == 0) break;
        for (size i = 1; i < nx; i++) /* V whole */
            for (size j = 0; j < i; j++) Qxx[i * stride + j] = Qxx[j * stride + i];
    }
    return 1;
}

ALL_KINDS static float dot(const float *a, const float *b, int n) {
    enum { PARTS = 8 };
    float sum[PARTS] = {0}, total = 0;
    int i = 0;
    for (; i + PARTS <= n; i += PARTS)
        for (int j = 0; j < PARTS; j++) sum[j] += a[i + j] * b[i + j];
    for (int j = 0; j < PARTS; j++) total += sum[j];
    for (; i < n; i++) total += a[i] * b[i];
    return total;
}

/* What the improved policy changes in the running cost, by the models. */
static void forward(const struct problem *p, const struct work *w) {
    const int nx = w->nx, nu = w->nu, nz = w->nz;
    float *dz = w->dz, *dx = w->dx; /* [dx du] before a step, dx after it */
    memset(dz, 0, sizeof(float) * nx);
    for (int t = 0; t < p->length; t++) {
        const float *F = p->F + (size_t)p->model[t] * nx * nz, *gradient = p->gradient + (size_t)t * nx;
        for (int i = 0; i < nu; i++) {
            const size_t at = (size_t)t * nu + i;
            dz[nx + i] = p->k[at] + dot(p->K + at * nx, dz, nx);
        }
        for (int i = 0; i < nx; i++) dx[i] = dot(F + i * nz, dz, nz);
        float change = 0;
        for (int i = 0; i < nx; i++) change += gradient[i] * dx[i];
        for (int i = 0; i < w->acting; i++) change += dot(p->hessian + i * nx, dx, w->acting) * dx[i] / 2;
        p->change[t] = change;
        memcpy(dz, dx, sizeof(float) * nx);
    }
}

enum { F, PRECISION, PRECISION_P, P_PRECISION_P, MODEL, GRADIENT, HESSIAN, DEVIATION, K, SMALL_K, CHANGE, ARRAYS };
static const int dimensions[ARRAYS] = {3, 2, 3, 3, 2, 3, 2, 3, 4, 3, 2};

/* Whether the shapes of all arrays follow from the numbers b, T, nx, nu and of models. */
static int fits(const Py_buffer *a, Py_ssize_t b, Py_ssize_t T, Py_ssize_t nx, Py_ssize_t nu, Py_ssize_t models) {
    const Py_ssize_t expected[ARRAYS][4] = {
        {models, nx, nx + nu}, {models, nu}, {models, nu, nx}, {models, nx, nx},
        {b, T},                {b, T, nx},   {nx, nx},         {b, T, nu},
        {b, T, nu, nx},        {b, T, nu},   {b, T},
    };
    for (int i = 0; i < ARRAYS; i++)
        for (int d = 0; d < dimensions[i]; d++)
            if (a[i].shape[d] != expected[i][d]) return 0;
    const int64_t *model = a[MODEL].buf;
    for (Py_ssize_t i = 0; i < b * T; i++)
        if (model[i] < 0 || model[i] >= models) return 0;
    return nx > 0 && nu > 0 && T > 0;
}

/* All sub-trajectories one after the other; returns the first that could not be solved, -1 if there is none. */
static Py_ssize_t run(const Py_buffer *a, struct work *w) {
    const Py_ssize_t b = a[GRADIENT].shape[0], T = a[GRADIENT].shape[1], nx = w->nx, nu = w->nu;
    for (Py_ssize_t i = 0; i < b; i++) {
        const struct problem problem = {
            .F = a[F].buf,
            .precision = a[PRECISION].buf,
            .precision_P = a[PRECISION_P].buf,
            .P_precision_P = a[P_PRECISION_P].buf,
            .gradient = (float *)a[GRADIENT].buf + i * T * nx,
            .hessian = a[HESSIAN].buf,
            .deviation = (float *)a[DEVIATION].buf + i * T * nu,
            .model = (int64_t *)a[MODEL].buf + i * T,
            .K = (float *)a[K].buf + i * T * nu * nx,
            .k = (float *)a[SMALL_K].buf + i * T * nu,
            .change = (float *)a[CHANGE].buf + i * T,
            .length = (int)T,
        };
        if (!backward(&problem, w)) return i;
        forward(&problem, w);
    }
    return -1;
}

/* Entries of a row for n. */
static int padded(int n) { return (n + COLUMNS - 1) / COLUMNS * COLUMNS; }

static PyObject *solve_all(const Py_buffer *a) {
    const int nx = (int)a[GRADIENT].shape[2], nu = (int)a[DEVIATION].shape[2], nz = nx + nu;
    struct work w = {.nx = nx, .nu = nu, .nz = nz, .width = padded(nz + 1), .gains_width = padded(nx + 1)};
    const float *hessian = a[HESSIAN].buf;
    for (int i = 0; i < nx * nx; i++)
        if (hessian[i] != 0 && w.acting <= i / nx) w.acting = i / nx + 1;
    const size_t F_n = (nx + 2) * w.width, VF_n = (nx + ROWS) * w.width, Q_n = (nz + ROWS + 1) * w.width;
    const size_t bytes = sizeof(float) * (F_n + VF_n + Q_n + 2 * w.width + nu * w.gains_width);
    float *memory = aligned_alloc(COLUMNS * sizeof(float), bytes);
    if (!memory) return PyErr_NoMemory();
    memset(memory, 0, bytes);
    w.F = memory, w.VF = w.F + F_n, w.Q = w.VF + VF_n, w.dz = w.Q + Q_n, w.dx = w.dz + w.width, w.gains = w.dx + w.width;
    w.F[nx * w.width + nz] = 1;
    Py_ssize_t failed;
    Py_BEGIN_ALLOW_THREADS;
    failed = run(a, &w);
    Py_END_ALLOW_THREADS;
    free(memory);
    return PyLong_FromSsize_t(failed);
}

/*
 * improve(F, precision, precision_P, P_precision_P, model, gradient, hessian, deviation, K, k, change): contiguous arrays
 * of float32, `model` of int64; the last three are written. Returns the first sub-trajectory that could not be solved, -1
 * if there is none.
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
        fits(a, a[GRADIENT].shape[0], a[GRADIENT].shape[1], a[GRADIENT].shape[2], a[DEVIATION].shape[2], a[F].shape[0]))
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
