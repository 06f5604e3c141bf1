/*
 * The LQG backward pass along sub-trajectories, and the forward pass that predicts its gain: what learner/lqg.py states.
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

/* Row-major matrices whose rows have `width` lanes, filled up with zeros; `system` has [Quu -Qux -qu]. */
struct work {
    int nx, nu, nz, width, system_width, acting; /* acting: leading entries of x with a row of H that is not zero */
    lanes *F, *V, *VF, *Q, *system, *next;
    float *v, *q;
};

static int lanes_of(int n) { return (n + LANES - 1) / LANES; }

/*
 * The first `width` lanes of C [rows, stride] = A B, where a(i, k) = a[i * row + k * column] and B is [inner, stride].
 */
BOTH_KINDS static void multiply(const float *a, int row, int column, int rows, int inner, const lanes *b, lanes *c,
                                int width, int stride) {
    for (int i = 0; i < rows; i += 2) {
        const float *first = a + (size_t)i * row, *second = i + 1 < rows ? first + row : first;
        lanes *to = c + (size_t)i * stride, *also = i + 1 < rows ? to + stride : to;
        int at = 0;
        for (; at + 4 <= width; at += 4) {
            lanes s[8] = {{0}};
            const lanes *from = b + at;
            for (int k = 0; k < inner; k++, from += stride) {
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
                s += first[k * column] * b[k * stride + at];
                t += second[k * column] * b[k * stride + at];
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

/*
 * Solves A X = B, given in rows [A B] of `width` lanes, B from lane `first` on: X takes the place of B and the Cholesky
 * factor U of A = U'U that of A's upper half. Returns 0 if A is not positive definite.
 */
BOTH_KINDS static int solve(lanes *system, int n, int first, int width) {
    for (int k = 0; k < n; k++) {
        lanes *pivot = system + (size_t)k * width;
        const float *U = (float *)pivot;
        if (!(U[k] > 0)) return 0;
        const float scale = 1 / sqrtf(U[k]);
        for (int j = k / LANES; j < width; j++) pivot[j] *= scale;
        for (int i = k + 1; i < n; i++) {
            lanes *row = system + (size_t)i * width;
            for (int j = i / LANES; j < width; j++) row[j] -= U[i] * pivot[j];
        }
    }
    for (int k = n - 1; k >= 0; k--) {
        lanes *solved = system + (size_t)k * width;
        const float scale = 1 / ((float *)solved)[k];
        for (int j = first; j < width; j++) solved[j] *= scale;
        for (int i = 0; i < k; i++) {
            lanes *row = system + (size_t)i * width;
            const float factor = ((float *)row)[k];
            for (int j = first; j < width; j++) row[j] -= factor * solved[j];
        }
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

BOTH_KINDS static int backward(const struct problem *p, const struct work *w) {
    const int nx = w->nx, nu = w->nu, nz = w->nz, width = w->width, stride = width * LANES;
    const int first = lanes_of(nu), narrow = lanes_of(nx + 1), system_stride = w->system_width * LANES;
    float *V = (float *)w->V, *Q = (float *)w->Q, *F = (float *)w->F;
    memset(V, 0, sizeof(float) * nx * stride);
    for (int i = 0; i < nx; i++) memcpy(V + i * stride, p->hessian + i * nx, sizeof(float) * nx);
    memcpy(w->v, p->gradient + (size_t)(p->length - 1) * nx, sizeof(float) * nx);
    for (int t = p->length - 1; t >= 0; t--) {
        const size_t m = (size_t)p->model[t];
        const float *precision = p->precision + m * nu, *precision_P = p->precision_P + m * nu * nx;
        const float *deviation = p->deviation + (size_t)t * nu;
        for (int i = 0; i < nx; i++) memcpy(F + i * stride, p->F + (m * nx + i) * nz, sizeof(float) * nz);
        const int rank = t == p->length - 1 ? w->acting : nx; /* rows of V that are not zero */
        multiply(V, stride, 1, rank, rank, w->F, w->VF, width, width);
        multiply(F, 1, stride, nx, rank, w->VF, w->Q, lanes_of(nx), width); /* Qxx */
        multiply(F + nx, 1, stride, nu, rank, w->VF, w->Q + nx * width, width, width); /* Qux Quu */
        multiply(w->v, 0, 1, 1, nx, w->F, (lanes *)w->q, width, width);
        float *Qux = Q + nx * stride;
        for (int i = 0; i < nu; i++) {
            float *row = (float *)w->system + i * system_stride, *restrict gains = row + first * LANES;
            float *restrict Qux_i = Qux + i * stride;
            const float *restrict precision_P_i = precision_P + i * nx;
            memcpy(row, Qux_i + nx, sizeof(float) * nu);
            row[i] += precision[i];
            for (int j = 0; j < nx; j++) gains[j] = -(Qux_i[j] -= precision_P_i[j]);
            gains[nx] = -(w->q[nx + i] + precision[i] * deviation[i]);
        }
        if (!solve(w->system, nu, first, w->system_width)) return 0;
        for (int i = 0; i < nu; i++) {
            const float *gains = (float *)w->system + i * system_stride + first * LANES;
            memcpy(p->K + ((size_t)t * nu + i) * nx, gains, sizeof(float) * nx);
            p->k[(size_t)t * nu + i] = gains[nx];
        }
        if (t == 0) break;
        multiply(Qux, 1, stride, nx, nu, w->system + first, w->next, narrow, w->system_width); /* Qxu [K k] */
        const float *both = p->P_precision_P + m * nx * nx, *gradient = p->gradient + (size_t)(t - 1) * nx;
        float *restrict v = w->v;
        for (int i = 0; i < nx; i++) {
            float *restrict V_i = V + i * stride;
            const float *restrict Q_i = Q + i * stride, *restrict next = (float *)w->next + i * system_stride;
            const float *restrict both_i = both + i * nx, *restrict hessian = p->hessian + i * nx;
            for (int j = 0; j < nx; j++) V_i[j] = Q_i[j] + both_i[j] + next[j] + hessian[j];
            v[i] = w->q[i] + next[nx] + gradient[i];
        }
        for (int i = 0; i < nu; i++) {
            const float *restrict precision_P_i = precision_P + i * nx;
            for (int j = 0; j < nx; j++) v[j] -= deviation[i] * precision_P_i[j];
        }
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

static PyObject *solve_all(const Py_buffer *a) {
    const int nx = (int)a[GRADIENT].shape[2], nu = (int)a[DEVIATION].shape[2], nz = nx + nu;
    const int width = lanes_of(nz), system_width = lanes_of(nu) + lanes_of(nx + 1);
    struct work w = {.nx = nx, .nu = nu, .nz = nz, .width = width, .system_width = system_width};
    const float *hessian = a[HESSIAN].buf;
    for (int i = 0; i < nx * nx; i++)
        if (hessian[i] != 0 && w.acting <= i / nx) w.acting = i / nx + 1;
    const size_t lanes_n = (size_t)(3 * nx + nz + 2) * width + (size_t)nz * system_width;
    lanes *memory = aligned_alloc(sizeof(lanes), lanes_n * sizeof(lanes));
    if (!memory) return PyErr_NoMemory();
    memset(memory, 0, lanes_n * sizeof(lanes));
    w.F = memory, w.V = w.F + nx * width, w.VF = w.V + nx * width, w.Q = w.VF + nx * width;
    w.v = (float *)(w.Q + nz * width), w.q = w.v + width * LANES;
    w.system = w.Q + (nz + 2) * width, w.next = w.system + nu * system_width;
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
