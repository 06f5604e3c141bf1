/*
 * The iterations of Bullet's solver over the contacts of bars, in place of its general ones.
 *
 * A bar is a multibody without joints: six velocities. Ground does not move, so the half of a row that belongs to it is
 * zero. Bullet finds the point of the friction cone by an angle, its sine and its cosine; here the same point is a ratio.
 * Whatever else there may be - joints, moving rigid bodies, rolling friction, other modes of the solver - stays Bullet's.
 *
 * iterate takes the place of solveGroupCacheFriendlyIterations in the table of virtual functions of
 * btMultiBodyConstraintSolver. The declarations are those of PyBullet 3.2.7, in double precision.
 */
#include <math.h>
#include <stddef.h>
#include <stdint.h>

#include "override.h"

enum { VELOCITIES = 6 };
enum { TWO_FRICTION_DIRECTIONS = 16, NO_FRICTION_CONE = 2048 }; /* bits of the mode */

struct array { /* btAlignedObjectArray */
    int32_t allocator, size, capacity;
    void *data;
    int64_t owns;
};

struct multibody { /* btMultiBody */
    char before[384];
    struct array velocity_changes;
    char between[577];
    char position_is_updated;
    char flags[2];
    int32_t joints;
};

struct side { /* of a row: where its body has its velocity changes and its Jacobian */
    int32_t velocity, jacobian;
};

struct row { /* btMultiBodySolverConstraint */
    struct side side_a, side_b;
    double vectors[6][4];
    double push_impulse, impulse, friction, inverse_mass, target, softness, lower, upper, penetration;
    void *point;
    int32_t iterations, other;
    int32_t rigid_a;
    struct multibody *body_a;
    int32_t link_a, rigid_b;
    struct multibody *body_b;
    int32_t link_b;
    void *constraint;
    int32_t joint;
};

struct rigid { /* btSolverBody */
    char before[480];
    const void *body;
};

struct solver { /* btMultiBodyConstraintSolver */
    void *vtable;
    struct array rigid_bodies, contacts, joints, friction, rolling;
    char between[128];
    int32_t most_iterations, fixed;
    char before_residual[64];
    double residual;
    char analytics[40];
    struct array multibody_joints, normal_rows, friction_rows, torsional_rows, spinning_rows;
    struct array jacobians, responses, velocity_changes;
};

struct info { /* btContactSolverInfo */
    char before[40];
    int32_t iterations;
    char between[132];
    int32_t mode;
    char until[28];
    double residual;
    char flags[12];
    int32_t report;
};

_Static_assert(sizeof(struct array) == 32 && sizeof(struct row) == 352 && sizeof(struct rigid) == 488, "layout");
_Static_assert(offsetof(struct multibody, position_is_updated) == 993, "layout");
_Static_assert(offsetof(struct multibody, joints) == 996, "layout");
_Static_assert(offsetof(struct row, impulse) == 216 && offsetof(struct row, other) == 292, "layout");
_Static_assert(offsetof(struct row, body_a) == 304 && offsetof(struct row, body_b) == 320, "layout");
_Static_assert(offsetof(struct solver, most_iterations) == 296, "layout");
_Static_assert(offsetof(struct solver, residual) == 368, "layout");
_Static_assert(offsetof(struct solver, multibody_joints) == 416, "layout");
_Static_assert(offsetof(struct solver, velocity_changes) == 640, "layout");
_Static_assert(offsetof(struct info, mode) == 176 && offsetof(struct info, residual) == 208, "layout");
_Static_assert(offsetof(struct info, report) == 228, "layout");

typedef double (*iterate_function)(struct solver *, void **bodies, int bodies_n, void **manifolds, int manifolds_n,
                                   void **constraints, int constraints_n, const struct info *, void *drawer);
static iterate_function general; /* Bullet's own */

/* Whether a body is a bar whose own sum of velocity changes is still that of the solver, or ground. */
static int is_bar_or_ground(const struct solver *solver, const struct multibody *body, struct side side, int rigid) {
    if (!body) return rigid >= 0 && !((const struct rigid *)solver->rigid_bodies.data)[rigid].body;
    const double *own = body->velocity_changes.data, *ours = (double *)solver->velocity_changes.data + side.velocity;
    if (body->joints) return 0;
    for (int i = 0; i < VELOCITIES; i++)
        if (own[i] != ours[i]) return 0;
    return 1;
}

/* Whether there is nothing to solve but contacts of bars with each other and the ground, with a friction cone. */
static int is_contact_of_bars(const struct solver *solver, int constraints_n, const struct info *info) {
    const int rows_n = solver->normal_rows.size;
    if (constraints_n || solver->contacts.size || solver->joints.size || solver->rolling.size ||
        solver->multibody_joints.size || solver->torsional_rows.size || solver->spinning_rows.size ||
        solver->friction_rows.size != 2 * rows_n || solver->most_iterations > info->iterations || info->report ||
        (info->mode & (TWO_FRICTION_DIRECTIONS | NO_FRICTION_CONE)) != TWO_FRICTION_DIRECTIONS)
        return 0;
    const struct row *normal = solver->normal_rows.data;
    for (int i = 0; i < rows_n; i++)
        if (!is_bar_or_ground(solver, normal[i].body_a, normal[i].side_a, normal[i].rigid_a) ||
            !is_bar_or_ground(solver, normal[i].body_b, normal[i].side_b, normal[i].rigid_b))
            return 0;
    return 1;
}

static double dot(const double *a, const double *b) {
    double sum = 0;
    for (int i = 0; i < VELOCITIES; i++) sum += a[i] * b[i];
    return sum;
}

/* The impulse that a row would add, were there no limits. */
static double wanted(const struct solver *solver, const struct row *row) {
    const double *jacobian = solver->jacobians.data, *velocity = solver->velocity_changes.data;
    double impulse = row->target - row->impulse * row->softness;
    if (row->body_a)
        impulse -= dot(jacobian + row->side_a.jacobian, velocity + row->side_a.velocity) * row->inverse_mass;
    if (row->body_b)
        impulse -= dot(jacobian + row->side_b.jacobian, velocity + row->side_b.velocity) * row->inverse_mass;
    return impulse;
}

static void change(const struct solver *solver, struct side side, double impulse) {
    const double *response = (double *)solver->responses.data + side.jacobian;
    double *velocity = (double *)solver->velocity_changes.data + side.velocity;
    for (int i = 0; i < VELOCITIES; i++) velocity[i] += response[i] * impulse;
}

/* Gives a row a new impulse; returns the change of velocity along it (m/s). */
static double apply(const struct solver *solver, struct row *row, double impulse, double added) {
    row->impulse = impulse;
    if (row->body_a) change(solver, row->side_a, added);
    if (row->body_b) change(solver, row->side_b, added);
    return added / row->inverse_mass;
}

static double solve_normal(const struct solver *solver, struct row *row) {
    double added = wanted(solver, row), impulse = row->impulse + added;
    if (impulse < row->lower || impulse > row->upper) {
        impulse = impulse < row->lower ? row->lower : row->upper;
        added = impulse - row->impulse;
    }
    return apply(solver, row, impulse, added);
}

/* The two directions of one contact, limited together by the impulse of its normal row. */
static double solve_friction(const struct solver *solver, struct row *row, double normal_impulse) {
    double added[2], impulse[2];
    for (int i = 0; i < 2; i++) {
        added[i] = wanted(solver, row + i);
        impulse[i] = row[i].impulse + added[i];
    }
    const double length2 = impulse[0] * impulse[0] + impulse[1] * impulse[1];
    const double limit[2] = {row[0].friction * normal_impulse, row[1].friction * normal_impulse};
    if (length2 > 0 && length2 >= limit[0] * limit[1]) {
        const double length = sqrt(length2);
        for (int i = 0; i < 2; i++) {
            const double share = fabs(limit[i]) / length;
            if (share >= 1) continue;
            impulse[i] *= share;
            added[i] = impulse[i] - row[i].impulse;
        }
    }
    double change = 0;
    for (int i = 0; i < 2; i++) change += apply(solver, row + i, impulse[i], added[i]);
    return change;
}

static double larger(double a, double b) { return a > b ? a : b; }

static double one_iteration(const struct solver *solver) {
    struct row *normal = solver->normal_rows.data, *friction = solver->friction_rows.data;
    const int rows_n = solver->normal_rows.size;
    double residual = 0;
    for (int i = 0; i < rows_n; i++) {
        const double change = solve_normal(solver, normal + i);
        residual = larger(residual, change * change);
    }
    for (int i = 0; i < rows_n; i++) {
        const double change = solve_friction(solver, friction + 2 * i, normal[friction[2 * i].other].impulse);
        residual = larger(residual, change * change);
    }
    return residual;
}

/* Tells a body its changes of velocity. */
static void hand_over(const struct solver *solver, struct multibody *body, struct side side) {
    if (!body) return;
    double *own = body->velocity_changes.data;
    const double *ours = (double *)solver->velocity_changes.data + side.velocity;
    for (int i = 0; i < VELOCITIES; i++) own[i] = ours[i];
    body->position_is_updated = 0;
}

static double iterate(struct solver *solver, void **bodies, int bodies_n, void **manifolds, int manifolds_n,
                      void **constraints, int constraints_n, const struct info *info, void *drawer) {
    if (!is_contact_of_bars(solver, constraints_n, info))
        return general(solver, bodies, bodies_n, manifolds, manifolds_n, constraints, constraints_n, info, drawer);
    for (int i = 0; i < info->iterations; i++) {
        solver->residual = one_iteration(solver);
        if (solver->residual <= info->residual) break;
    }
    const struct row *normal = solver->normal_rows.data;
    for (int i = 0; i < solver->normal_rows.size; i++) {
        hand_over(solver, normal[i].body_a, normal[i].side_a);
        hand_over(solver, normal[i].body_b, normal[i].side_b);
    }
    return 0;
}

/* Puts iterate in place; false if the table is not the expected one. */
int override_iterations(void **table, void *expected) {
    general = (iterate_function)expected;
    return override(table, expected, (void *)(uintptr_t)iterate);
}
