/*
 * Contacts of a bar with the triangles of the ground, in place of Bullet's general distance algorithm.
 *
 * Bullet runs an iteration (GJK) on every triangle that meets the bounding box of a bar. A bar is a capsule: all points
 * within its radius of a segment, and the closest points of a segment and a triangle have a closed form. Most triangles
 * are too far for a contact and are dropped first. An axis that crosses a triangle has no direction to its closest point:
 * that case stays Bullet's.
 *
 * process_triangle takes the place of btConvexTriangleCallback::processTriangle in that class's table of virtual
 * functions. The declarations are those of PyBullet 3.2.7, in double precision.
 */
#include <math.h>
#include <stddef.h>
#include <stdint.h>

#include "override.h"

enum { CAPSULE = 10 };          /* type of shape */
enum { ADD_CONTACT_POINT = 4 }; /* entry of an object's table, after two destructors and two setters of identifiers */

typedef double vector[4]; /* btVector3: the fourth is padding */

struct transform {
    vector basis[3]; /* rows */
    vector origin;
};

struct capsule { /* btCapsuleShapeZ */
    void *vtable;
    int32_t type;
    void *user_pointer;
    int32_t user_indices[2];
    vector scaling, dimensions; /* radius, radius, half the length of the axis */
    double margin, padding;
    int32_t up_axis;
};

struct wrapper { /* btCollisionObjectWrapper */
    const struct wrapper *parent;
    const struct capsule *shape;
    const void *object;
    const struct transform *transform;
};

struct result { /* btManifoldResult */
    void **vtable;
};

struct callback { /* btConvexTriangleCallback */
    void *vtable;
    vector box_min, box_max;
    const struct wrapper *convex, *ground;
    struct result *result;
    void *dispatcher;
    const void *dispatch_info;
    double triangle_margin;
};

/* A contact's largest gap is this share of the radius of a bounding sphere (gContactBreakingThreshold). */
static const double GAP = 0.02;
/* Nearer than this, the axis of a bar crosses a triangle (m). */
static const double CROSSING = 1e-4;

typedef void (*process_function)(struct callback *, const vector *corners, int part, int index);
typedef void (*add_function)(struct result *, const vector normal, const vector point, double depth);
static process_function measure; /* Bullet's own */

static double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static void subtract(const double *a, const double *b, double *out) {
    for (int i = 0; i < 3; i++) out[i] = a[i] - b[i];
}

static void cross(const double *a, const double *b, double *out) {
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

static double to_unit(double value) { return value < 0 ? 0 : value > 1 ? 1 : value; }

/* The closest points of a segment and a triangle. */
struct closest {
    double distance2;
    double on_segment[3], on_triangle[3];
};

/* Keeps the closest points of the segment p + s d and the edge q + t e, s and t in [0, 1], if they are nearer; r = p - q. */
static void compare_edge(struct closest *closest, const double *p, const double *d, const double *q, const double *e,
                         const double *r) {
    const double a = dot(d, d), b = dot(d, e), c = dot(d, r), f = dot(e, r), l = dot(e, e), det = a * l - b * b;
    double s = det > 1e-12 * a * l ? to_unit((b * f - c * l) / det) : 0, t = (b * s + f) / l;
    if (t < 0) {
        t = 0;
        s = to_unit(-c / a);
    } else if (t > 1) {
        t = 1;
        s = to_unit((b - c) / a);
    }
    double gap[3];
    for (int i = 0; i < 3; i++) gap[i] = r[i] + s * d[i] - t * e[i];
    const double distance2 = dot(gap, gap);
    if (distance2 >= closest->distance2) return;
    closest->distance2 = distance2;
    for (int i = 0; i < 3; i++) {
        closest->on_segment[i] = p[i] + s * d[i];
        closest->on_triangle[i] = q[i] + t * e[i];
    }
}

/* Whether the point at s of the segment lies over the triangle; `from` leads from the corners to the segment's start. */
static int is_over(double from[3][3], double edge[3][3], const double *normal, const double *d, double s) {
    for (int i = 0; i < 3; i++) {
        double inward[3], to[3];
        cross(normal, edge[i], inward);
        for (int j = 0; j < 3; j++) to[j] = from[i][j] + s * d[j];
        if (dot(inward, to) < 0) return 0;
    }
    return 1;
}

/* Whether the corners lie all on one side of the plane through p across `axis`, and farther than `reach` from it. */
static int is_beside(const double *p, const double *axis, const vector *corner, double reach) {
    const double far2 = reach * reach * dot(axis, axis);
    double from[3], first = 0;
    for (int i = 0; i < 3; i++) {
        subtract(corner[i], p, from);
        const double side = dot(from, axis);
        if (side * side <= far2 || side * first < 0) return 0;
        first = side;
    }
    return 1;
}

/*
 * The closest points of the segment p + s d, s in [0, 1], and a triangle. Returns 0 if they are farther apart than
 * `reach`; otherwise 1, with a distance of 0 where the segment crosses the triangle.
 */
int closest_points(const double *p, const double *d, const vector *corner, double reach, struct closest *closest) {
    const double across[3] = {-d[1], d[0], 0};
    if (is_beside(p, across, corner, reach)) return 0;
    double edge[3][3], normal[3], from[3][3];
    for (int i = 0; i < 3; i++) {
        subtract(corner[(i + 1) % 3], corner[i], edge[i]);
        subtract(p, corner[i], from[i]);
    }
    cross(edge[0], edge[1], normal);
    const double start = dot(from[0], normal), end = start + dot(d, normal), normal2 = dot(normal, normal);
    /* Where the segment is nearest to the plane: if that lies over the triangle, no point is nearer to the triangle. */
    const int crosses = start * end <= 0;
    const double s = crosses ? (start == end ? 0 : start / (start - end)) : start * start > end * end;
    const double height = crosses ? 0 : s ? end : start;
    if (height * height > reach * reach * normal2) return 0;
    if (is_over(from, edge, normal, d, s)) {
        for (int i = 0; i < 3; i++) {
            closest->on_segment[i] = p[i] + s * d[i];
            closest->on_triangle[i] = closest->on_segment[i] - height / normal2 * normal[i];
        }
        closest->distance2 = height * height / normal2;
        return 1;
    }
    closest->distance2 = reach * reach;
    for (int i = 0; i < 3; i++) compare_edge(closest, p, d, corner[i], edge[i], from[i]);
    return closest->distance2 < reach * reach;
}

static int is_identity(const struct transform *transform) {
    return transform->basis[0][0] == 1 && transform->basis[1][1] == 1 && transform->basis[2][2] == 1 &&
           transform->origin[0] == 0 && transform->origin[1] == 0 && transform->origin[2] == 0;
}

static void process_triangle(struct callback *callback, const vector *corners, int part, int index) {
    const struct capsule *capsule = callback->convex->shape;
    const struct transform *bar = callback->convex->transform;
    if (capsule->type != CAPSULE || capsule->up_axis != 2 || callback->convex->parent ||
        !is_identity(callback->ground->transform)) {
        measure(callback, corners, part, index);
        return;
    }
    const double radius = capsule->dimensions[0], half = capsule->dimensions[2];
    double axis[3], first[3];
    for (int i = 0; i < 3; i++) {
        axis[i] = 2 * half * bar->basis[i][2];
        first[i] = bar->origin[i] - half * bar->basis[i][2];
    }
    const double sphere = half + 3 * radius; /* not below Bullet's, which encloses the bounding box */
    const double thickness = radius + callback->triangle_margin;
    struct closest closest;
    if (!closest_points(first, axis, corners, thickness + GAP * sphere, &closest)) return;
    if (closest.distance2 < CROSSING * CROSSING) {
        measure(callback, corners, part, index);
        return;
    }
    const double distance = sqrt(closest.distance2);
    vector normal = {0}, point = {0};
    for (int i = 0; i < 3; i++) {
        normal[i] = (closest.on_segment[i] - closest.on_triangle[i]) / distance;
        point[i] = closest.on_triangle[i] + callback->triangle_margin * normal[i];
    }
    ((add_function)callback->result->vtable[ADD_CONTACT_POINT])(callback->result, normal, point, distance - thickness);
}

/* Puts process_triangle in place; false if the table is not the expected one. */
int override_triangles(void **table, void *expected) {
    measure = (process_function)expected;
    return override(table, expected, (void *)(uintptr_t)process_triangle);
}
