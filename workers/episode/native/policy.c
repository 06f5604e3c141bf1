/*
 * The policy's network on one observation: the products of weights and vectors, and tanh between the layers.
 *
 * Every output sums its products in the order of the inputs, eight outputs side by side, and tanh is computed here:
 * the same bits on every processor, which libraries do not promise. workers/episode/policy.py packs the weights.
 */
#define PY_SSIZE_T_CLEAN
#include <Python.h>

enum { LANES = 8, BLOCK = 4 * LANES, WIDEST = 4096 };
typedef float lanes __attribute__((vector_size(LANES * sizeof(float)), aligned(sizeof(float))));

#define BOTH_KINDS __attribute__((target_clones("avx2", "default"))) /* without FMA: the same bits */

/* Block after block of 32 outputs: their biases [32], then their weights [inputs, 32]. Returns what follows. */
BOTH_KINDS static const float *product(const float *parameters, const float *in, int in_n, int out_n, float *out) {
    for (int first = 0; first < out_n; first += BLOCK) {
        const lanes *at = (const lanes *)parameters;
        lanes a = at[0], b = at[1], c = at[2], d = at[3];
        for (int i = 0; i < in_n; i++) {
            at += BLOCK / LANES;
            a += at[0] * in[i];
            b += at[1] * in[i];
            c += at[2] * in[i];
            d += at[3] * in[i];
        }
        lanes *to = (lanes *)(out + first);
        to[0] = a, to[1] = b, to[2] = c, to[3] = d;
        parameters += BLOCK * (in_n + 1);
    }
    return parameters;
}

/* tanh to 2e-7: Lambert's continued fraction at a quarter of x, then twice tanh 2y = 2 tanh y / (1 + tanh^2 y). */
BOTH_KINDS static void tanh_all(float *x, int n) {
    for (int i = 0; i < n; i++) {
        const float y = 0.25f * (x[i] > 9.0f ? 9.0f : x[i] < -9.0f ? -9.0f : x[i]), s = y * y;
        float t = y * (135135.0f + s * (17325.0f + s * (378.0f + s))) /
                  (135135.0f + s * (62370.0f + s * (3150.0f + s * 28.0f)));
        t = (t + t) / (1.0f + t * t);
        x[i] = (t + t) / (1.0f + t * t);
    }
}

static int rounded_up(int n) { return (n + BLOCK - 1) / BLOCK * BLOCK; }

static int fits(const Py_buffer *parameters, const int *widths, int layers_n) {
    Py_ssize_t expected = 0;
    for (int layer = 0; layer < layers_n; layer++) {
        if (widths[layer] < 1 || widths[layer + 1] < 1 || widths[layer] > WIDEST || widths[layer + 1] > WIDEST) return 0;
        expected += (Py_ssize_t)rounded_up(widths[layer + 1]) * (widths[layer] + 1);
    }
    return parameters->len == expected * (Py_ssize_t)sizeof(float);
}

/*
 * act(parameters float32, widths int32 [layers + 1], observation float32, out: writable float64, offset, scale), arrays
 * contiguous: out is offset + scale times what the network gives.
 */
static PyObject *act(PyObject *self, PyObject *const *arguments, Py_ssize_t n) {
    (void)self;
    static const char *const formats[4] = {"f", "i", "f", "d"};
    Py_buffer buffers[4];
    int opened = 0;
    if (n != 6) return PyErr_Format(PyExc_TypeError, "act takes 6 arguments");
    const float offset = (float)PyFloat_AsDouble(arguments[4]), scale = (float)PyFloat_AsDouble(arguments[5]);
    if (PyErr_Occurred()) return NULL;
    while (opened < 4 && PyObject_GetBuffer(arguments[opened], &buffers[opened],
                                            PyBUF_FORMAT | (opened < 3 ? PyBUF_CONTIG_RO : PyBUF_CONTIG)) == 0)
        opened++;
    int plain = opened == 4;
    for (int i = 0; plain && i < 4; i++) plain = strcmp(buffers[i].format, formats[i]) == 0;
    if (plain) {
        const int *widths = buffers[1].buf, layers_n = (int)(buffers[1].len / (Py_ssize_t)sizeof(int)) - 1;
        plain = layers_n > 0 && fits(&buffers[0], widths, layers_n) &&
                buffers[2].len == widths[0] * (Py_ssize_t)sizeof(float) &&
                buffers[3].len == widths[layers_n] * (Py_ssize_t)sizeof(double);
        if (plain) {
            float values[2][WIDEST];
            const float *in = buffers[2].buf, *parameters = buffers[0].buf;
            for (int layer = 0; layer < layers_n; layer++) {
                float *out = values[layer % 2];
                parameters = product(parameters, in, widths[layer], widths[layer + 1], out);
                if (layer + 1 < layers_n) tanh_all(out, widths[layer + 1]);
                in = out;
            }
            double *commands = buffers[3].buf;
            for (int i = 0; i < widths[layers_n]; i++) commands[i] = offset + scale * in[i];
        }
    }
    if (!plain && !PyErr_Occurred()) PyErr_SetString(PyExc_ValueError, "act: arrays of other types or sizes");
    while (opened > 0) PyBuffer_Release(&buffers[--opened]);
    if (!plain) return NULL;
    Py_RETURN_NONE;
}

static PyMethodDef methods[] = {
    {"act", (PyCFunction)(void (*)(void))act, METH_FASTCALL, "Write what the network gives for an observation."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef module = {PyModuleDef_HEAD_INIT, "_policy", NULL, -1, methods, NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__policy(void) { return PyModule_Create(&module); }
