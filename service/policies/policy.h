/*
 * Policy @VERSION@ of the T6-GPS run @RUN@: from what a robot measures to the rest lengths of its 24 cables.
 *
 * C99, no memory is allocated, no library but libm is needed (-lm). Include this file in one source file:
 *
 *     t6gps_state state = T6GPS_START;
 *     t6gps_measurement measured;     every T6GPS_CONTROL_PERIOD_S, fill it
 *     double commands[T6GPS_CABLES];
 *     t6gps_decide(&measured, &state, commands);
 *
 * Geometry is computed in double, the network in float, in the same order as the simulator does: the same bits where the
 * compiler fuses no products and sums (-ffp-contract=off, which -std=c99 implies for gcc).
 *
 * t6gps-policy: @DESCRIPTION@
 */
#ifndef T6GPS_POLICY_H
#define T6GPS_POLICY_H

#include <math.h>

enum { T6GPS_NODES = 12, T6GPS_BARS = 6, T6GPS_CABLES = 24, T6GPS_FACES = 20, T6GPS_ELEMENTS = 24 };
enum { T6GPS_SEEN = @SEEN@, T6GPS_WIDEST = @WIDEST@, T6GPS_LAYERS = @LAYERS@ };
#define T6GPS_SCHEMA_VERSION @SCHEMA@
#define T6GPS_POLICY_VERSION @VERSION@
#define T6GPS_RUN "@RUN@"
#define T6GPS_SHA256 "@SHA256@"
#define T6GPS_CONTROL_PERIOD_S @PERIOD@
#define T6GPS_SHORTEST_M @SHORTEST@
#define T6GPS_LONGEST_M @LONGEST@

/* What is measured, in world coordinates with z up. */
typedef struct {
    double nodes[12][3];                 /* ends of the bars (m); nodes 2b and 2b + 1 end bar b */
    double com_velocity[3];              /* of the centre of mass (m/s) */
    double bar_angular_velocities[6][3]; /* in the axes of the world (rad/s) */
    double rest_lengths[24];             /* of the cables, as the winches have them now (m) */
    double waypoint[2];                  /* where to roll to (m) */
} t6gps_measurement;

/* Support triangle and symmetry element of the decision before. */
typedef struct {
    int face, element;
} t6gps_state;
#define T6GPS_START {-1, -1}

/* Pairs of nodes that the cables join, in the order of rest lengths and commands. */
static const signed char t6gps_cables[24][2] = @CABLES@;

static const signed char t6gps_faces[20][3] = @FACES@;
static const signed char t6gps_kinds[20] = @KINDS@;
static const signed char t6gps_transition[21][25][20] = @TRANSITION@;
static const signed char t6gps_element_by_edge[20][3] = @ELEMENT_BY_EDGE@;
static const signed char t6gps_corners_from[24][2][3] = @CORNERS_FROM@;
static const signed char t6gps_nodes_from[24][12] = @NODES_FROM@;
static const signed char t6gps_bars_from[24][6] = @BARS_FROM@;
static const signed char t6gps_cables_from[24][24] = @CABLES_FROM@;
static const double t6gps_side[24] = @SIDE@;
static const double t6gps_reference_triangles[2][3][2] = @REFERENCE_TRIANGLES@;

/* Widths of the layers; then layer by layer its biases and its weights, input by input. */
static const int t6gps_widths[@LAYERS@ + 1] = @WIDTHS@;
static const float t6gps_parameters[@PARAMETERS_N@] = @PARAMETERS@;

static inline double t6gps_within(double value, double low, double high) {
    return value < low ? low : value > high ? high : value;
}

/* The face through which the vertical ray from the centre of mass leaves the body, the lowest if there are several. */
static inline int t6gps_support_face(const t6gps_measurement *measured, const double com[3]) {
    int lowest = -1, lowest_mean = 0;
    double height = com[2], least_sum = HUGE_VAL;
    for (int face = 0; face < T6GPS_FACES; face++) {
        double x[3], y[3], z[3], area[3];
        for (int corner = 0; corner < 3; corner++) {
            const double *node = measured->nodes[t6gps_faces[face][corner]];
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

/* The symmetry element of the frame of a face; a state that is none counts as the start. */
static inline int t6gps_element(const t6gps_measurement *measured, const double com[3], const t6gps_state *before,
                                int face) {
    const int known_face = before->face >= 0 && before->face < T6GPS_FACES;
    const int known_element = before->element >= 0 && before->element < T6GPS_ELEMENTS;
    const int known = t6gps_transition[known_face ? before->face : T6GPS_FACES]
                                      [known_element ? before->element : T6GPS_ELEMENTS][face];
    if (known >= 0) return known;
    int nearest = 0;
    double least = HUGE_VAL;
    for (int edge = t6gps_kinds[face]; edge < 3; edge++) { /* edge 0 of a Lambda is no cable */
        const double *start = measured->nodes[t6gps_faces[face][edge]];
        const double *end = measured->nodes[t6gps_faces[face][(edge + 1) % 3]];
        const double x = end[0] - start[0], y = end[1] - start[1];
        const double distance = fabs(x * (start[1] - com[1]) - y * (start[0] - com[0])) / hypot(x, y);
        if (distance < least) least = distance, nearest = edge;
    }
    return t6gps_element_by_edge[face][nearest < t6gps_kinds[face] ? t6gps_kinds[face] : nearest];
}

/* The turn (rad) that gives the support triangle its reference orientation. */
static inline double t6gps_yaw(const t6gps_measurement *measured, int kind, int element) {
    const double side = t6gps_side[element];
    double x[3], y[3], mean_x = 0, mean_y = 0, twist = 0, along = 0;
    for (int corner = 0; corner < 3; corner++) {
        const double *node = measured->nodes[t6gps_corners_from[element][kind][corner]];
        x[corner] = node[0], y[corner] = node[1];
        mean_x += node[0] / 3, mean_y += node[1] / 3;
    }
    for (int corner = 0; corner < 3; corner++) {
        const double *goal = t6gps_reference_triangles[kind][corner];
        const double dx = x[corner] - mean_x, dy = side * (y[corner] - mean_y);
        twist += dx * goal[1] - dy * goal[0];
        along += dx * goal[0] + dy * goal[1];
    }
    return atan2(twist, along);
}

static inline void t6gps_direction(float *out, double c, double s, double side, double x, double y) {
    out[0] = (float)(c * x - s * side * y);
    out[1] = (float)(s * x + c * side * y);
}

/* What the policy sees [83]; the entries are those of the table `frames`. */
static inline void t6gps_observe(const t6gps_measurement *measured, const double com[3], int face, int element,
                                 float out[83]) {
    const int kind = t6gps_kinds[face];
    const double yaw = t6gps_yaw(measured, kind, element), side = t6gps_side[element], c = cos(yaw), s = sin(yaw);
    out[0] = (float)kind;
    for (int cable = 0; cable < T6GPS_CABLES; cable++)
        out[1 + cable] = (float)((measured->rest_lengths[t6gps_cables_from[element][cable]] - @OFFSET@) / @REST_SCALE@);
    for (int bar = 0; bar < T6GPS_BARS; bar++) { /* a mirror maps the pseudo-vector by det(W) W */
        const double *from = measured->bar_angular_velocities[t6gps_bars_from[element][bar]];
        const double x = from[0] / @ANGULAR_SCALE@, y = from[1] / @ANGULAR_SCALE@, z = from[2] / @ANGULAR_SCALE@;
        out[25 + 3 * bar] = (float)(side * c * x - s * y);
        out[26 + 3 * bar] = (float)(side * s * x + c * y);
        out[27 + 3 * bar] = (float)(side * z);
    }
    const double way_x = measured->waypoint[0] - com[0], way_y = measured->waypoint[1] - com[1];
    const double distance = fmax(hypot(way_x, way_y), @NEAREST@);
    const double *velocity = measured->com_velocity;
    const double speed = fmax(hypot(velocity[0], velocity[1]), @SLOWEST@);
    t6gps_direction(out + 43, c, s, side, way_x / distance, way_y / distance);
    t6gps_direction(out + 45, c, s, side, velocity[0] / speed, velocity[1] / speed);
    for (int node = 0; node < T6GPS_NODES; node++) {
        const double *from = measured->nodes[t6gps_nodes_from[element][node]];
        const double x = (from[0] - com[0]) / @NODE_SCALE@, y = side * (from[1] - com[1]) / @NODE_SCALE@;
        const double canonical[3] = {c * x - s * y, s * x + c * y, (from[2] - com[2]) / @NODE_SCALE@};
        for (int i = 0; i < 3; i++)
            out[47 + 3 * node + i] = (float)t6gps_within(canonical[i], -@FARTHEST@, @FARTHEST@);
    }
}

/* One layer; returns the parameters of the next. */
static inline const float *t6gps_layer(const float *restrict parameters, const float *restrict in, int in_n, int out_n,
                                       float *restrict out) {
    for (int o = 0; o < out_n; o++) out[o] = parameters[o];
    parameters += out_n;
    for (int i = 0; i < in_n; i++, parameters += out_n)
        for (int o = 0; o < out_n; o++) out[o] += parameters[o] * in[i];
    return parameters;
}

/* tanh to 2e-7: Lambert's continued fraction at a quarter of x, then twice tanh 2y = 2 tanh y / (1 + tanh^2 y). */
static inline void t6gps_tanh(float *x, int n) {
    for (int i = 0; i < n; i++) {
        const float y = 0.25f * (x[i] > 9.0f ? 9.0f : x[i] < -9.0f ? -9.0f : x[i]), s = y * y;
        float t = y * (135135.0f + s * (17325.0f + s * (378.0f + s))) /
                  (135135.0f + s * (62370.0f + s * (3150.0f + s * 28.0f)));
        t = (t + t) / (1.0f + t * t);
        x[i] = (t + t) / (1.0f + t * t);
    }
}

/* True where a number is not finite: infinity and NaN less themselves are no zero. */
static inline int t6gps_lost(const t6gps_measurement *measured) {
    const double *values = (const double *)measured;
    int lost = 0;
    for (unsigned i = 0; i < sizeof *measured / sizeof *values; i++) lost |= values[i] - values[i] != 0;
    return lost;
}

/* Rest lengths to command for one control period (m), in the order of t6gps_cables; `state` becomes the next. Where a
 * number is not finite, all commands are NaN and `state` stays. */
static inline void t6gps_decide(const t6gps_measurement *measured, t6gps_state *state, double commands[24]) {
    if (t6gps_lost(measured)) {
        for (int cable = 0; cable < T6GPS_CABLES; cable++) commands[cable] = NAN;
        return;
    }
    double com[3];
    for (int i = 0; i < 3; i++) {
        com[i] = 0;
        for (int bar = 0; bar < T6GPS_BARS; bar++)
            com[i] += (measured->nodes[2 * bar][i] + measured->nodes[2 * bar + 1][i]) / 2;
        com[i] /= T6GPS_BARS;
    }
    const int face = t6gps_support_face(measured, com);
    const int element = t6gps_element(measured, com, state, face);
    float values[2][T6GPS_WIDEST];
    t6gps_observe(measured, com, face, element, values[1]);
    const float *parameters = t6gps_parameters;
    for (int layer = 0; layer < T6GPS_LAYERS; layer++) {
        const float *in = values[(layer + 1) % 2];
        float *out = values[layer % 2];
        parameters = t6gps_layer(parameters, in, t6gps_widths[layer], t6gps_widths[layer + 1], out);
        if (layer + 1 < T6GPS_LAYERS) t6gps_tanh(out, t6gps_widths[layer + 1]);
    }
    const float *last = values[(T6GPS_LAYERS + 1) % 2];
    for (int cable = 0; cable < T6GPS_CABLES; cable++)
        commands[t6gps_cables_from[element][cable]] =
            t6gps_within(@OFFSET_FLOAT@ + @SCALE_FLOAT@ * last[cable], T6GPS_SHORTEST_M, T6GPS_LONGEST_M);
    state->face = face, state->element = element;
}

#endif
