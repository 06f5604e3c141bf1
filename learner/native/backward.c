/*
 * The LQG backward pass along sub-trajectories and the forward pass that predicts its gain, as learner/lqg.py states them.
 *
 * The matrices are small (39 states, 24 actions), so that calls of a general library cost more than the arithmetic; here
 * they stay in the first cache. Every sum has one order: the same bits on every processor.
 */
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { LANES = 8 };
typedef float lanes __attribute__((vector_size(LANES * sizeof(float))));
typedef lanes unaligned __attribute__((aligned(sizeof(float))));

#define BOTH_KINDS __attribute__((target_clones("avx2", "default"))) /* without FMA: the same bits */

/* Row-major matrices whose rows have `width` lanes, filled up with zeros. */
struct work {
    int nx, nu, nz, width;
    lanes *F, *V, *VF, *Q, *gains, *next;
    float *v, *q;
};

/* C [rows, width] = A B, where a(i, k) = a[i * row + k * column] and B has `inner` rows. */
BOTH_KINDS static void multiply(const float *a, int row, int column, int rows, int inner, const lanes *b, lanes *c,
                                int width) {
    for (int i = 0; i < rows; i += 2) {
        const float *first = a + (size_t)i * row, *second = i + 1 < rows ? first + row : first;
        lanes *to = c + (size_t)i * width, *also = i + 1 < rows ? to + width : to;
        int at = 0;
        for (; at + 4 <= width; at += 4) {
            lanes s[8] = {{0}};
            const lanes *from = b + at;
            for (int k = 0; k < inner; k++, from += width) {
                const float x = first[k * column], y = second[k * column];
                for (int j = 0; j < 4; j++) {
                    s[j] += x * from[j];
                    s[4 + j] += y * from[j];
                }
            }
            for (int j = 0; j < 4; j++) to[at + j] = s[j], also[at + j] = s[4 + j];
        }
        for (; at < width; at++) {
            lanes s = {0}, t = {0};
            for (int k = 0; k < inner; k++) {
                s += first[k * column] * b[k * width + at];
                t += second[k * column] * b[k * width + at];
            }
            to[at] = s, also[at] = t;
        }
    }
}

BOTH_KINDS static float dot(const float *a, const float *b, int n) {
    lanes sum = {0};
    int i = 0;
    for (; i + LANES <= n; i += LANES) sum += *(const unaligned *)(a + i) * *(const unaligned *)(b + i);
    float total = 0;
    for (int j = 0; j < LANES; j++) total += sum[j];
    for (; i < n; i++) total += a[i] * b[i];
    return total;
}

/* row_i -= factor * row_k */
static inline void subtract(lanes *to, float factor, const lanes *from, int width) {
    for (int j = 0; j < width; j++) to[j] -= factor * from[j];
}

/*
 * Solves A X = B in place of B [n, width], by the Cholesky factors U'U of A, whose upper half lies in rows of `stride`
 * floats and is overwritten by U. Returns 0 if A is not positive definite.
 */
BOTH_KINDS static int solve(float *A, int stride, int n, lanes *B, int width) {
    for (int k = 0; k < n; k++) {
        float *pivot = A + (size_t)k * stride;
        if (!(pivot[k] > 0)) return 0;
        const float scale = 1 / sqrtf(pivot[k]);
        for (int j = k; j < n; j++) pivot[j] *= scale;
        for (int i = k + 1; i < n; i++) {
            float *row = A + (size_t)i * stride;
            const float factor = pivot[i];
            for (int j = i; j < n; j++) row[j] -= factor * pivot[j];
        }
        for (int j = 0; j < width; j++) B[k * width + j] *= scale;
        for (int i = k + 1; i < n; i++) subtract(B + (size_t)i * width, pivot[i], B + (size_t)k * width, width);
    }
    for (int k = n - 1; k >= 0; k--) {
        const float scale = 1 / A[(size_t)k * stride + k];
        for (int j = 0; j < width; j++) B[k * width + j] *= scale;
        for (int i = 0; i < k; i++) subtract(B + (size_t)i * width, A[(size_t)i * stride + k], B + (size_t)k * width, width);
    }
    return 1;
}

/* What is given and found along one sub-trajectory; all arrays contiguous, shapes in learner/lqg.py. */
struct problem {
    const float *F, *precision, *precision_P, *P_precision_P, *gradient, *hessian, *deviation;
    const int64_t *model;
    float *K, *k, *change;
    int length;
};

static int backward(const struct problem *p, const struct work *w) {
    const int nx = w->nx, nu = w->nu, nz = w->nz, width = w->width, stride = width * LANES;
    const int narrow = (nx + LANES) / LANES; /* lanes of [Qux qu] */
    float *V = (float *)w->V, *Q = (float *)w->Q, *F = (float *)w->F, *gains = (float *)w->gains;
    memset(V, 0, sizeof(float) * nx * stride);
    for (int i = 0; i < nx; i++) memcpy(V + i * stride, p->hessian + i * nx, sizeof(float) * nx);
    memcpy(w->v, p->gradient + (size_t)(p->length - 1) * nx, sizeof(float) * nx);
    for (int t = p->length - 1; t >= 0; t--) {
        const size_t m = (size_t)p->model[t];
        const float *precision = p->precision + m * nu, *precision_P = p->precision_P + m * nu * nx;
        const float *deviation = p->deviation + (size_t)t * nu;
        for (int i = 0; i < nx; i++) memcpy(F + i * stride, p->F + (m * nx + i) * nz, sizeof(float) * nz);
        multiply(V, stride, 1, nx, nx, w->F, w->VF, width);
        multiply(F, 1, stride, nz, nx, w->VF, w->Q, width);
        multiply(w->v, 0, 1, 1, nx, w->F, (lanes *)w->q, width);
        float *Quu = Q + nx * stride + nx, *Qux = Q + nx * stride;
        for (int i = 0; i < nu; i++) {
            for (int j = 0; j < nx; j++) Qux[i * stride + j] -= precision_P[i * nx + j];
            Quu[i * stride + i] += precision[i];
            w->q[nx + i] += precision[i] * deviation[i];
            memset(gains + i * narrow * LANES, 0, sizeof(float) * narrow * LANES);
            for (int j = 0; j < nx; j++) gains[i * narrow * LANES + j] = -Qux[i * stride + j];
            gains[i * narrow * LANES + nx] = -w->q[nx + i];
        }
        if (!solve(Quu, stride, nu, w->gains, narrow)) return 0;
        for (int i = 0; i < nu; i++) {
            memcpy(p->K + ((size_t)t * nu + i) * nx, gains + i * narrow * LANES, sizeof(float) * nx);
            p->k[(size_t)t * nu + i] = gains[i * narrow * LANES + nx];
        }
        if (t == 0) break;
        multiply(Qux, 1, stride, nx, nu, w->gains, w->next, narrow); /* Qxu [K k] */
        const float *next = (float *)w->next, *both = p->P_precision_P + m * nx * nx;
        for (int i = 0; i < nx; i++)
            for (int j = 0; j <= i; j++) {
                const float one = Q[i * stride + j] + both[i * nx + j] + next[i * narrow * LANES + j];
                const float other = Q[j * stride + i] + both[j * nx + i] + next[j * narrow * LANES + i];
                V[i * stride + j] = V[j * stride + i] = (one + other) / 2 + p->hessian[i * nx + j];
            }
        for (int j = 0; j < nx; j++)
            w->v[j] = w->q[j] + next[j * narrow * LANES + nx] + p->gradient[(size_t)(t - 1) * nx + j];
        for (int i = 0; i < nu; i++)
            for (int j = 0; j < nx; j++) w->v[j] -= deviation[i] * precision_P[i * nx + j];
    }
    return 1;
}

/* What the improved policy changes in the running cost, by the models. */
static void forward(const struct problem *p, const struct work *w) {
    const int nx = w->nx, nu = w->nu, nz = w->nz;
    float *dz = w->q, *dx = w->v; /* [dx du] before a step, dx after it */
    memset(dz, 0, sizeof(float) * nx);
    for (int t = 0; t < p->length; t++) {
        const float *F = p->F + (size_t)p->model[t] * nx * nz, *gradient = p->gradient + (size_t)t * nx;
        for (int i = 0; i < nu; i++) {
            const size_t at = (size_t)t * nu + i;
            dz[nx + i] = p->k[at] + dot(p->K + at * nx, dz, nx);
        }
        for (int i = 0; i < nx; i++) dx[i] = dot(F + i * nz, dz, nz);
        float change = 0;
        for (int i = 0; i < nx; i++) change += (gradient[i] + dot(p->hessian + i * nx, dx, nx) / 2) * dx[i];
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

static PyObject *solve_all(const Py_buffer *a) {
    const int nx = (int)a[GRADIENT].shape[2], nu = (int)a[DEVIATION].shape[2], nz = nx + nu;
    const int width = (nz + LANES - 1) / LANES, narrow = (nx + LANES) / LANES;
    struct work w = {.nx = nx, .nu = nu, .nz = nz, .width = width};
    const size_t lanes_n = (size_t)(3 * nx + nz + 2) * width + (size_t)nz * narrow;
    lanes *memory = aligned_alloc(sizeof(lanes), lanes_n * sizeof(lanes));
    if (!memory) return PyErr_NoMemory();
    memset(memory, 0, lanes_n * sizeof(lanes));
    w.F = memory, w.V = w.F + nx * width, w.VF = w.V + nx * width, w.Q = w.VF + nx * width;
    w.v = (float *)(w.Q + nz * width), w.q = w.v + width * LANES;
    w.gains = w.Q + (nz + 2) * width, w.next = w.gains + nu * narrow;
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

PyMODINIT_FUNC PyInit__backward(void) { return PyModule_Create(&module); }
