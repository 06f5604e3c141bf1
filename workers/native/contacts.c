/*
 * Spares Bullet the distance between a capsule and a triangle that cannot touch it.
 *
 * Bullet runs its general distance algorithm on every triangle that meets the bounding box of a bar, and nearly all of
 * them are too far for a contact. The test here is exact for a capsule's axis and a triangle, so that Bullet sees every
 * triangle that can give a contact and its results stay the same to the last bit.
 *
 * It takes the place of btConvexTriangleCallback::processTriangle in that class's table of virtual functions. The
 * declarations are those of PyBullet 3.2.7, in double precision.
 */
#define _GNU_SOURCE
#include <stddef.h>
#include <stdint.h>
#include <sys/mman.h>
#include <unistd.h>

enum { CAPSULE = 10, PROCESS_TRIANGLE = 4 }; /* type of shape; entry of the table, after two of RTTI, two destructors */

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

struct callback { /* btConvexTriangleCallback */
    void *vtable;
    vector box_min, box_max;
    const struct wrapper *convex, *ground;
    void *result, *dispatcher;
    const void *dispatch_info;
    double triangle_margin;
};

/* A contact's largest gap is this share of the radius of a bounding sphere (gContactBreakingThreshold). */
static const double GAP = 0.02;

typedef void (*process_function)(struct callback *, const vector *corners, int part, int index);
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

/* Squared distance of the segments p + s d and q + t e, s and t in [0, 1], with r = p - q. */
static double segments_distance2(const double *d, const double *e, const double *r) {
    const double a = dot(d, d), b = dot(d, e), c = dot(d, r), f = dot(e, r), l = dot(e, e), det = a * l - b * b;
    double s = det > 1e-12 * a * l ? to_unit((b * f - c * l) / det) : 0, t = (b * s + f) / l, gap[3];
    if (t < 0) {
        t = 0;
        s = to_unit(-c / a);
    } else if (t > 1) {
        t = 1;
        s = to_unit((b - c) / a);
    }
    for (int i = 0; i < 3; i++) gap[i] = r[i] + s * d[i] - t * e[i];
    return dot(gap, gap);
}

/* Whether the segment p + s d, s in [0, 1], comes within `reach` of a triangle; exact but for rounding. */
int segment_is_near(const double *p, const double *d, const vector *corner, double reach) {
    double edge[3][3], normal[3], from[3][3];
    for (int i = 0; i < 3; i++) {
        subtract(corner[(i + 1) % 3], corner[i], edge[i]);
        subtract(p, corner[i], from[i]);
    }
    cross(edge[0], edge[1], normal);
    const double start = dot(from[0], normal), end = start + dot(d, normal);
    const double reach2 = reach * reach, plane_reach2 = reach2 * dot(normal, normal);
    if (start * end > 0 && start * start > plane_reach2 && end * end > plane_reach2) return 0;
    for (int i = 0; i < 3; i++)
        if (segments_distance2(d, edge[i], from[i]) < reach2) return 1;
    /* No edge is near: the segment is near if it comes within reach of the plane inside the triangle. */
    const double s = start == end ? 0 : to_unit(start / (start - end));
    for (int i = 0; i < 3; i++) {
        double inward[3], to[3];
        cross(normal, edge[i], inward);
        for (int j = 0; j < 3; j++) to[j] = from[i][j] + s * d[j];
        if (dot(inward, to) < 0) return 0;
    }
    return 1;
}

/* A vector of the world, seen from `transform`. */
static void seen(const struct transform *transform, const double *vector_, double *out) {
    for (int i = 0; i < 3; i++)
        out[i] = transform->basis[0][i] * vector_[0] + transform->basis[1][i] * vector_[1] +
                 transform->basis[2][i] * vector_[2];
}

static void process_triangle(struct callback *callback, const vector *corners, int part, int index) {
    const struct capsule *capsule = callback->convex->shape;
    if (capsule->type == CAPSULE && capsule->up_axis == 2 && !callback->convex->parent) {
        const struct transform *bar = callback->convex->transform, *ground = callback->ground->transform;
        const double radius = capsule->dimensions[0], half = capsule->dimensions[2];
        double axis[3], first[3], world_axis[3], world_first[3];
        for (int i = 0; i < 3; i++) {
            world_axis[i] = 2 * half * bar->basis[i][2];
            world_first[i] = bar->origin[i] - half * bar->basis[i][2] - ground->origin[i];
        }
        seen(ground, world_axis, axis);
        seen(ground, world_first, first);
        const double sphere = half + 3 * radius; /* not below Bullet's, which encloses the bounding box */
        const double reach = radius + callback->triangle_margin + GAP * sphere;
        if (!segment_is_near(first, axis, corners, reach)) return;
    }
    measure(callback, corners, part, index);
}

/* Puts the test in place, once in a process; false if the table is not the expected one. */
int cull_triangles(uintptr_t vtable, uintptr_t expected) {
    void **entry = (void **)vtable + PROCESS_TRIANGLE;
    void *const ours = (void *)(uintptr_t)process_triangle;
    if (*entry == ours) return 1;
    if (*entry != (void *)expected) return 0;
    const uintptr_t page_size = (uintptr_t)sysconf(_SC_PAGESIZE);
    void *page = (void *)((uintptr_t)entry & ~(page_size - 1));
    if (mprotect(page, page_size, PROT_READ | PROT_WRITE)) return 0;
    measure = (process_function)expected;
    *entry = ours;
    mprotect(page, page_size, PROT_READ);
    return 1;
}
