/*
 * What a worker computes between two control steps: nodes, support triangle, frame and observation of a state.
 *
 * The same definitions as support.support_face, symmetry.frame_yaw, observation.observe and Terrain.height, which are
 * the reference that this module is tested against. It holds no robot: `bind` takes the tables of topology and symmetry once.
 */
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <math.h>
#include <string.h>

enum { BARS = 6, NODES = 12, CABLES = 24, FACES = 20, ELEMENTS = 24, SENSORS = 47, OBSERVATION = SENSORS + 3 * NODES };
enum { POSITION = 0, ORIENTATION = 3, VELOCITY = 7, ANGULAR_VELOCITY = 10, NUMBERS = 13 }; /* of a bar, as RobotState.bars */
enum { ANY = -1 }; /* rows and columns of a square of any size */

static struct {
    int64_t faces[FACES][3], kinds[FACES], reference_face[2];
    int64_t nodes_from[ELEMENTS][NODES], bars_from[ELEMENTS][BARS], cables_from[ELEMENTS][CABLES];
    int64_t proper[ELEMENTS];
    double reference_triangles[2][3][2];
    double bar_length, rest_length_scale, angular_velocity_scale, slowest_track, node_scale, farthest_node;
} tables;

/* A view of a buffer of doubles [rows, columns] or [n], whatever its strides. */
struct view {
    Py_buffer buffer;
    Py_ssize_t row, column;
};

static double at(const struct view *view, int i, int j) {
    return *(const double *)((const char *)view->buffer.buf + i * view->row + j * view->column);
}

static int open_view(PyObject *object, struct view *view, Py_ssize_t rows, Py_ssize_t columns) {
    if (PyObject_GetBuffer(object, &view->buffer, PyBUF_STRIDED_RO | PyBUF_FORMAT) != 0) return -1;
    const Py_buffer *b = &view->buffer;
    const int square = columns == ANY && b->ndim == 2 && b->shape[0] == b->shape[1] && b->shape[0] > 1;
    const int plain = columns == 1 ? b->ndim == 1 : b->ndim == 2 && b->shape[1] == columns;
    if (!(square || (plain && b->shape[0] == rows)) || strcmp(b->format, "d") != 0) {
        if (columns == ANY)
            PyErr_SetString(PyExc_ValueError, "expected float64 [n, n], n above 1");
        else
            PyErr_Format(PyExc_ValueError, "expected float64 [%zd, %zd]", rows, columns);
        PyBuffer_Release(&view->buffer);
        return -1;
    }
    view->row = b->strides[0];
    view->column = columns == 1 ? 0 : b->strides[1];
    return 0;
}

static void find_nodes(const struct view *bars, double nodes[NODES][3]) {
    for (int bar = 0; bar < BARS; bar++) {
        const double x = at(bars, bar, ORIENTATION), y = at(bars, bar, ORIENTATION + 1);
        const double z = at(bars, bar, ORIENTATION + 2), w = at(bars, bar, ORIENTATION + 3);
        const double arm[3] = {(x * z + w * y) * tables.bar_length, (y * z - w * x) * tables.bar_length,
                               (0.5 - x * x - y * y) * tables.bar_length};
        for (int i = 0; i < 3; i++) {
            nodes[2 * bar][i] = at(bars, bar, POSITION + i) + arm[i];
            nodes[2 * bar + 1][i] = at(bars, bar, POSITION + i) - arm[i];
        }
    }
}

/* Mean over the bars of three of their numbers. */
static void mean_of(const struct view *bars, int first, double mean[3]) {
    for (int i = 0; i < 3; i++) {
        mean[i] = 0;
        for (int bar = 0; bar < BARS; bar++) mean[i] += at(bars, bar, first + i);
        mean[i] /= BARS;
    }
}

static int support_face(double nodes[NODES][3], const double com[3]) {
    int lowest = -1, lowest_mean = 0;
    double height = com[2], least_sum = INFINITY;
    for (int face = 0; face < FACES; face++) {
        double x[3], y[3], z[3], area[3];
        for (int corner = 0; corner < 3; corner++) {
            const double *node = nodes[tables.faces[face][corner]];
            x[corner] = node[0] - com[0], y[corner] = node[1] - com[1], z[corner] = node[2];
        }
        for (int corner = 0; corner < 3; corner++) {
            const int a = (corner + 1) % 3, b = (corner + 2) % 3;
            area[corner] = x[a] * y[b] - x[b] * y[a];
        }
        const double sum = z[0] + z[1] + z[2];
        if (sum < least_sum) least_sum = sum, lowest_mean = face;
        const int left = area[0] >= 0 && area[1] >= 0 && area[2] >= 0;
        const int right = area[0] <= 0 && area[1] <= 0 && area[2] <= 0;
        if (!left && !right) continue;
        const double below = (area[0] * z[0] + area[1] * z[1] + area[2] * z[2]) / (area[0] + area[1] + area[2]);
        if (below < height) height = below, lowest = face;
    }
    return lowest < 0 ? lowest_mean : lowest;
}

static double frame_yaw(double nodes[NODES][3], int face, int element) {
    const int64_t kind = tables.kinds[face];
    const int64_t *reference = tables.faces[tables.reference_face[kind]];
    const double side = tables.proper[element] ? 1.0 : -1.0;
    double x[3], y[3], mean_x = 0, mean_y = 0, twist = 0, along = 0;
    for (int corner = 0; corner < 3; corner++) {
        const double *node = nodes[tables.nodes_from[element][reference[corner]]];
        x[corner] = node[0], y[corner] = node[1];
        mean_x += node[0] / 3, mean_y += node[1] / 3;
    }
    for (int corner = 0; corner < 3; corner++) {
        const double *goal = tables.reference_triangles[kind][corner];
        const double dx = x[corner] - mean_x, dy = side * (y[corner] - mean_y);
        twist += dx * goal[1] - dy * goal[0];
        along += dx * goal[0] + dy * goal[1];
    }
    return atan2(twist, along);
}

/* survey(bars [6, 13]) -> (face, com x, com y, com z) */
static PyObject *survey(PyObject *self, PyObject *argument) {
    (void)self;
    struct view bars;
    if (open_view(argument, &bars, BARS, NUMBERS) != 0) return NULL;
    double nodes[NODES][3], com[3];
    find_nodes(&bars, nodes);
    mean_of(&bars, POSITION, com);
    PyBuffer_Release(&bars.buffer);
    return Py_BuildValue("iddd", support_face(nodes, com), com[0], com[1], com[2]);
}

/* Height of the ground at a place, as Terrain.height; heights [n, n]. */
static double ground_height(const struct view *heights, double cell, double x, double y) {
    const int last = (int)heights->buffer.shape[0] - 1;
    const double u = fmin(fmax(x / cell + last / 2.0, 0), last), v = fmin(fmax(y / cell + last / 2.0, 0), last);
    const int i = u < last ? (int)u : last - 1, j = v < last ? (int)v : last - 1;
    const double a = u - i, b = v - j, corner = at(heights, i, j), far = at(heights, i + 1, j + 1);
    const double turning = a >= b ? at(heights, i + 1, j) : at(heights, i, j + 1);
    return a >= b ? corner + a * (turning - corner) + b * (far - turning)
                  : corner + b * (turning - corner) + a * (far - turning);
}

/* extremes(bars [6, 13], heights [n, n], cell) -> (largest |x| or |y|, largest depth) of nodes */
static PyObject *extremes(PyObject *self, PyObject *const *arguments, Py_ssize_t n) {
    (void)self;
    struct view bars, heights;
    if (n != 3) return PyErr_Format(PyExc_TypeError, "extremes takes 3 arguments");
    const double cell = PyFloat_AsDouble(arguments[2]);
    if (PyErr_Occurred() || open_view(arguments[0], &bars, BARS, NUMBERS) != 0) return NULL;
    PyObject *result = NULL;
    if (open_view(arguments[1], &heights, ANY, ANY) == 0) {
        double nodes[NODES][3], side = 0, depth = -INFINITY;
        find_nodes(&bars, nodes);
        for (int node = 0; node < NODES; node++) {
            const double *at_node = nodes[node];
            side = fmax(side, fmax(fabs(at_node[0]), fabs(at_node[1])));
            depth = fmax(depth, ground_height(&heights, cell, at_node[0], at_node[1]) - at_node[2]);
        }
        result = Py_BuildValue("dd", side, depth);
        PyBuffer_Release(&heights.buffer);
    }
    PyBuffer_Release(&bars.buffer);
    return result;
}

static double within(double value, double low, double high) { return value < low ? low : value > high ? high : value; }

static void put_direction(float *out, double yaw, double side, double x, double y) {
    out[0] = (float)(cos(yaw) * x - sin(yaw) * side * y);
    out[1] = (float)(sin(yaw) * x + cos(yaw) * side * y);
}

/*
 * observe(bars [6, 13], rest lengths [24], face, element, target x, target y, nominal rest length,
 *         out: writable float32 [83]) -> yaw
 */
static PyObject *observe(PyObject *self, PyObject *const *objects, Py_ssize_t n) {
    (void)self;
    if (n != 8) return PyErr_Format(PyExc_TypeError, "observe takes 8 arguments");
    const long face = PyLong_AsLong(objects[2]), element = PyLong_AsLong(objects[3]);
    const double target[2] = {PyFloat_AsDouble(objects[4]), PyFloat_AsDouble(objects[5])};
    const double nominal = PyFloat_AsDouble(objects[6]);
    struct view bars, rest_lengths;
    Py_buffer out_buffer;
    PyObject *result = NULL;
    if (PyErr_Occurred() || open_view(objects[0], &bars, BARS, NUMBERS) != 0) return NULL;
    if (open_view(objects[1], &rest_lengths, CABLES, 1) != 0) goto release_bars;
    if (PyObject_GetBuffer(objects[7], &out_buffer, PyBUF_CONTIG | PyBUF_FORMAT) != 0) goto release_rest_lengths;
    const int fits = out_buffer.len == OBSERVATION * (Py_ssize_t)sizeof(float) && strcmp(out_buffer.format, "f") == 0;
    if (!fits || face < 0 || face >= FACES || element < 0 || element >= ELEMENTS) {
        PyErr_SetString(PyExc_ValueError, "observe: face, element or output out of range");
    } else {
        double nodes[NODES][3], com[3], velocity[3];
        find_nodes(&bars, nodes);
        mean_of(&bars, POSITION, com);
        mean_of(&bars, VELOCITY, velocity);
        const double yaw = frame_yaw(nodes, (int)face, (int)element), side = tables.proper[element] ? 1.0 : -1.0;
        const double c = cos(yaw), s = sin(yaw);
        float *out = out_buffer.buf;
        out[0] = (float)tables.kinds[face];
        for (int cable = 0; cable < CABLES; cable++)
            out[1 + cable] =
                (float)((at(&rest_lengths, (int)tables.cables_from[element][cable], 0) - nominal) / tables.rest_length_scale);
        for (int bar = 0; bar < BARS; bar++) { /* a mirror maps the pseudo-vector by det(W) W */
            const int from = (int)tables.bars_from[element][bar];
            const double x = at(&bars, from, ANGULAR_VELOCITY) / tables.angular_velocity_scale;
            const double y = at(&bars, from, ANGULAR_VELOCITY + 1) / tables.angular_velocity_scale;
            const double z = at(&bars, from, ANGULAR_VELOCITY + 2) / tables.angular_velocity_scale;
            out[25 + 3 * bar] = (float)(side * c * x - s * y);
            out[26 + 3 * bar] = (float)(side * s * x + c * y);
            out[27 + 3 * bar] = (float)(side * z);
        }
        const double speed = fmax(hypot(velocity[0], velocity[1]), tables.slowest_track);
        put_direction(out + 43, yaw, side, target[0], target[1]);
        put_direction(out + 45, yaw, side, velocity[0] / speed, velocity[1] / speed);
        for (int node = 0; node < NODES; node++) {
            const double *from = nodes[tables.nodes_from[element][node]];
            const double x = (from[0] - com[0]) / tables.node_scale, y = side * (from[1] - com[1]) / tables.node_scale;
            const double canonical[3] = {c * x - s * y, s * x + c * y, (from[2] - com[2]) / tables.node_scale};
            for (int i = 0; i < 3; i++)
                out[SENSORS + 3 * node + i] = (float)within(canonical[i], -tables.farthest_node, tables.farthest_node);
        }
        result = PyFloat_FromDouble(yaw);
    }
    PyBuffer_Release(&out_buffer);
release_rest_lengths:
    PyBuffer_Release(&rest_lengths.buffer);
release_bars:
    PyBuffer_Release(&bars.buffer);
    return result;
}

/*
 * steer(mean float64 [24] in canonical labels, departure [24] in world labels, element, shortest, longest,
 *       out: writable float64 [3, 24]): mean within the range, command in world labels, the same in canonical labels
 */
static PyObject *steer(PyObject *self, PyObject *const *objects, Py_ssize_t n) {
    (void)self;
    if (n != 6) return PyErr_Format(PyExc_TypeError, "steer takes 6 arguments");
    const long element = PyLong_AsLong(objects[2]);
    const double shortest = PyFloat_AsDouble(objects[3]), longest = PyFloat_AsDouble(objects[4]);
    if (PyErr_Occurred()) return NULL;
    struct view mean, departure;
    Py_buffer out_buffer;
    if (open_view(objects[0], &mean, CABLES, 1) != 0) return NULL;
    if (open_view(objects[1], &departure, CABLES, 1) != 0) {
        PyBuffer_Release(&mean.buffer);
        return NULL;
    }
    int done = 0;
    if (PyObject_GetBuffer(objects[5], &out_buffer, PyBUF_CONTIG | PyBUF_FORMAT) == 0) {
        const int fits = out_buffer.len == 3 * CABLES * (Py_ssize_t)sizeof(double) && strcmp(out_buffer.format, "d") == 0;
        if (!fits || element < 0 || element >= ELEMENTS) {
            PyErr_SetString(PyExc_ValueError, "steer: element or output out of range");
        } else {
            double *means = out_buffer.buf, *command = means + CABLES, *action = command + CABLES;
            for (int cable = 0; cable < CABLES; cable++) {
                const int from = (int)tables.cables_from[element][cable];
                means[cable] = within(at(&mean, cable, 0), shortest, longest);
                action[cable] = within(means[cable] + at(&departure, from, 0), shortest, longest);
                command[from] = action[cable];
            }
            done = 1;
        }
        PyBuffer_Release(&out_buffer);
    }
    PyBuffer_Release(&mean.buffer);
    PyBuffer_Release(&departure.buffer);
    if (!done) return NULL;
    Py_RETURN_NONE;
}

/* bind(bytes of the tables in the order of the struct) */
static PyObject *bind(PyObject *self, PyObject *bytes) {
    (void)self;
    char *source;
    Py_ssize_t length;
    if (PyBytes_AsStringAndSize(bytes, &source, &length) != 0) return NULL;
    if (length != (Py_ssize_t)sizeof tables)
        return PyErr_Format(PyExc_ValueError, "expected %zd bytes of tables, got %zd", (Py_ssize_t)sizeof tables, length);
    memcpy(&tables, source, sizeof tables);
    Py_RETURN_NONE;
}

static PyMethodDef methods[] = {
    {"bind", bind, METH_O, "Take the tables of topology and symmetry."},
    {"survey", survey, METH_O, "Support face and centre of mass of a state."},
    {"extremes", (PyCFunction)(void (*)(void))extremes, METH_FASTCALL, "Farthest side and largest depth of the nodes."},
    {"observe", (PyCFunction)(void (*)(void))observe, METH_FASTCALL, "Write the observation of a state; returns the turn of its frame."},
    {"steer", (PyCFunction)(void (*)(void))steer, METH_FASTCALL, "Write mean, command and action of a control step."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef module = {PyModuleDef_HEAD_INIT, "_observer", NULL, -1, methods, NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__observer(void) { return PyModule_Create(&module); }
