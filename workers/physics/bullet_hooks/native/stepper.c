/*
 * One control step of the robot inside Bullet: a plugin for pybullet.loadPlugin(path, "_t6gps").
 *
 * The law is that of workers/physics/cables.py, operation by operation, so that both give the same bits: in every physics
 * step (1) the bars are read, (2) the winches move, (3) forces are computed and applied, (4) Bullet steps.
 *
 * Python owns the data (struct block) and binds it once by address. Bullet's C functions come from the library of
 * the pybullet module, looked up at run time; the declarations below are those of PyBullet 3.2.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

enum { BARS = 6, NODES = 12, CABLES = 24, MISSING_NAME = 64 };
enum { BULLET_API_VERSION = 202010061, WORLD_FRAME = 2, BASE = -1 };
enum { POSE_SIZE = 7 * sizeof(double), VELOCITY_SIZE = 6 * sizeof(double) };
enum { MOST_DOUBLES = 2 << 20 }; /* the client's memory is 8 MB and a little */
enum result { DONE = 0, NOT_BOUND, OTHER_LAYOUT, NO_LIBRARY, NO_SYMBOL, NO_MEMORY, REFUSED };

typedef void *client_handle, *command_handle, *status_handle;

struct b3PluginContext { /* the fields behind these two are not used */
    client_handle client;
    void *user_pointer;
};

struct b3PluginArguments {
    char text[1024];
    int ints_n;
    int ints[128];
    int floats_n;
    double floats[128];
};

/* Shared with workers/physics/bullet_hooks/plugin.py (_BLOCK): the same fields in the same order. */
struct block {
    double winch_steps_m[CABLES];
    double stall; /* 0: none */
    double stiffness, damping, max_tension, axial_damping, span;
    double command[CABLES], rest[CABLES];
    double bars[BARS][13]; /* position, quaternion x y z w, velocity, angular velocity */
    int32_t bodies[BARS];
    int32_t cables[CABLES][2];
    int32_t steps_n, unused;
    char missing[MISSING_NAME];
};

struct bullet {
    command_handle (*b3InitStepSimulationCommand)(client_handle);
    command_handle (*b3RequestActualStateCommandInit)(client_handle, int body);
    command_handle (*b3ApplyExternalForceCommandInit)(client_handle);
    void (*b3ApplyExternalForce)(command_handle, int body, int link, const double *force, const double *at, int flag);
    void (*b3ApplyExternalTorque)(command_handle, int body, int link, const double *torque, int flag);
    int (*b3SubmitClientCommand)(client_handle, command_handle);
    status_handle (*b3ProcessServerStatus)(client_handle);
    int (*b3GetStatusType)(status_handle);
    int (*b3GetStatusActualState)(status_handle, int *body, int *q_n, int *u_n, const double **frame, const double **q,
                                  const double **u, const double **reactions);
};

struct stepper {
    struct bullet bullet;
    struct block *block;
    status_handle status;   /* the client's only one */
    int state_type;         /* its type after a state was read */
    const double *q, *u;    /* where Bullet writes states, NULL while unknown */
};

static int resolve(struct bullet *bullet, const char *library_path, char *missing) {
    void *library = dlopen(library_path, RTLD_LAZY | RTLD_NOLOAD);
    if (!library) return NO_LIBRARY;
#define RESOLVE(name)                                                       \
    if (!(*(void **)&bullet->name = dlsym(library, #name))) {               \
        strncpy(missing, #name, MISSING_NAME - 1);                          \
        dlclose(library);                                                   \
        return NO_SYMBOL;                                                   \
    }
    RESOLVE(b3InitStepSimulationCommand)
    RESOLVE(b3RequestActualStateCommandInit)
    RESOLVE(b3ApplyExternalForceCommandInit)
    RESOLVE(b3ApplyExternalForce)
    RESOLVE(b3ApplyExternalTorque)
    RESOLVE(b3SubmitClientCommand)
    RESOLVE(b3ProcessServerStatus)
    RESOLVE(b3GetStatusType)
    RESOLVE(b3GetStatusActualState)
#undef RESOLVE
    dlclose(library);
    return DONE;
}

/* A client in the same process answers at once; waiting, as b3SubmitClientCommandAndWaitStatus does, costs a sleep. */
static status_handle submit(const struct bullet *bullet, client_handle client, command_handle command) {
    bullet->b3SubmitClientCommand(client, command);
    return bullet->b3ProcessServerStatus(client);
}

static void find_original(struct stepper *stepper, const double *q, const double *u) {
    const double *end = q - (u - q);
    for (const double *at = stepper->status; at < end && q - at < MOST_DOUBLES; at++)
        if (at[0] == q[0] && !memcmp(at, q, POSE_SIZE) && !memcmp(at + (u - q), u, VELOCITY_SIZE)) {
            stepper->q = at;
            stepper->u = at + (u - q);
            return;
        }
}

/*
 * Reads a bar. Through its interface Bullet hands out a copy of what it wrote, 30 kB for every state, whatever the body
 * has. The original precedes the copy in the client's memory: it is looked for once, and read from then on.
 */
static int read_bar(struct stepper *stepper, client_handle client, int bar) {
    const struct bullet *bullet = &stepper->bullet;
    struct block *block = stepper->block;
    command_handle command = bullet->b3RequestActualStateCommandInit(client, block->bodies[bar]);
    const double *q = stepper->q, *u = stepper->u;
    if (q) {
        bullet->b3SubmitClientCommand(client, command);
        if (bullet->b3GetStatusType(stepper->status) != stepper->state_type) return REFUSED;
    } else {
        status_handle status = submit(bullet, client, command);
        if (!status || !bullet->b3GetStatusActualState(status, NULL, NULL, NULL, NULL, &q, &u, NULL)) return REFUSED;
        stepper->status = status;
        stepper->state_type = bullet->b3GetStatusType(status);
        find_original(stepper, q, u);
    }
    memcpy(block->bars[bar], q, POSE_SIZE);
    memcpy(block->bars[bar] + 7, u, VELOCITY_SIZE);
    return DONE;
}

static int read_bars(struct stepper *stepper, client_handle client) {
    int result = DONE;
    for (int bar = 0; bar < BARS && result == DONE; bar++) result = read_bar(stepper, client, bar);
    return result;
}

static void cross(const double *a, const double *b, double *out) {
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

static double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static double clip(double value, double bound) { return fmin(fmax(value, -bound), bound); }

struct geometry {
    double axes[BARS][3], arms[BARS][3];
    double gaps[CABLES][3], lengths[CABLES], rates[CABLES];
};

static void survey(const struct block *block, struct geometry *found) {
    double nodes[NODES][3], speeds[NODES][3];
    for (int bar = 0; bar < BARS; bar++) {
        const double *at = block->bars[bar], *q = at + 3, *velocity = at + 7, *omega = at + 10;
        double(*arms)[3] = found->arms, swing[3];
        arms[bar][0] = (q[0] * q[2] + q[3] * q[1]) * block->span;
        arms[bar][1] = (q[1] * q[2] - q[3] * q[0]) * block->span;
        arms[bar][2] = (0.5 - q[0] * q[0] - q[1] * q[1]) * block->span;
        for (int i = 0; i < 3; i++) found->axes[bar][i] = arms[bar][i] / (block->span / 2);
        cross(omega, arms[bar], swing);
        for (int i = 0; i < 3; i++) {
            nodes[2 * bar][i] = at[i] + arms[bar][i];
            nodes[2 * bar + 1][i] = at[i] - arms[bar][i];
            speeds[2 * bar][i] = velocity[i] + swing[i];
            speeds[2 * bar + 1][i] = velocity[i] - swing[i];
        }
    }
    for (int cable = 0; cable < CABLES; cable++) {
        const int a = block->cables[cable][0], b = block->cables[cable][1];
        double *gap = found->gaps[cable], gap_speed[3];
        for (int i = 0; i < 3; i++) {
            gap[i] = nodes[b][i] - nodes[a][i];
            gap_speed[i] = speeds[b][i] - speeds[a][i];
        }
        found->lengths[cable] = sqrt(dot(gap, gap));
        found->rates[cable] = dot(gap, gap_speed) / found->lengths[cable];
    }
}

static double tension(const struct block *block, const struct geometry *found, int cable) {
    const double elastic = block->stiffness * fmax(0.0, found->lengths[cable] - block->rest[cable]);
    return fmin(elastic + clip(block->damping * found->rates[cable], elastic), block->max_tension);
}

static void move_winches(struct block *block, const struct geometry *found) {
    for (int cable = 0; cable < CABLES; cable++) {
        const double reach = block->winch_steps_m[cable], change = block->command[cable] - block->rest[cable];
        double hauled = reach;
        if (block->stall > 0) hauled = reach * fmax(0.0, 1 - tension(block, found, cable) / block->stall);
        block->rest[cable] += fmin(fmax(change, -hauled), reach);
    }
}

static void loads(const struct block *block, const struct geometry *found, double forces[BARS][3],
                  double torques[BARS][3]) {
    double pulls[NODES][3] = {{0}};
    for (int cable = 0; cable < CABLES; cable++) {
        const int a = block->cables[cable][0], b = block->cables[cable][1];
        const double pulling = tension(block, found, cable);
        for (int i = 0; i < 3; i++) {
            const double pull = pulling / found->lengths[cable] * found->gaps[cable][i];
            pulls[a][i] += pull;
            pulls[b][i] -= pull;
        }
    }
    for (int bar = 0; bar < BARS; bar++) {
        const double *first = pulls[2 * bar], *second = pulls[2 * bar + 1];
        const double spin_torque = block->axial_damping * dot(block->bars[bar] + 10, found->axes[bar]);
        double couple[3];
        for (int i = 0; i < 3; i++) {
            forces[bar][i] = first[i] + second[i];
            couple[i] = first[i] - second[i];
        }
        cross(found->arms[bar], couple, torques[bar]);
        for (int i = 0; i < 3; i++) torques[bar][i] -= spin_torque * found->axes[bar][i];
    }
}

static void apply_loads(const struct bullet *bullet, client_handle client, const struct block *block,
                        const struct geometry *found) {
    double forces[BARS][3], torques[BARS][3];
    loads(block, found, forces, torques);
    for (int bar = 0; bar < BARS; bar++) { /* one load per command: Bullet mixes up several forces in one */
        const int body = block->bodies[bar];
        command_handle command = bullet->b3ApplyExternalForceCommandInit(client);
        bullet->b3ApplyExternalForce(command, body, BASE, forces[bar], block->bars[bar], WORLD_FRAME);
        submit(bullet, client, command);
        command = bullet->b3ApplyExternalForceCommandInit(client);
        bullet->b3ApplyExternalTorque(command, body, BASE, torques[bar], WORLD_FRAME);
        submit(bullet, client, command);
    }
}

static int control_step(struct stepper *stepper, client_handle client) {
    const struct bullet *bullet = &stepper->bullet;
    for (int step = 0; step < stepper->block->steps_n; step++) {
        struct geometry found;
        if (read_bars(stepper, client) != DONE) return REFUSED;
        survey(stepper->block, &found);
        move_winches(stepper->block, &found);
        apply_loads(bullet, client, stepper->block, &found);
        submit(bullet, client, bullet->b3InitStepSimulationCommand(client));
    }
    return read_bars(stepper, client);
}

/* Arguments: the path of pybullet's library; size of the block, low and high half of its address. */
static int bind(struct b3PluginContext *context, const struct b3PluginArguments *arguments) {
    if (arguments->ints[0] != (int)sizeof(struct block)) return OTHER_LAYOUT;
    const uint64_t address = (uint32_t)arguments->ints[1] | (uint64_t)(uint32_t)arguments->ints[2] << 32;
    struct stepper *stepper = context->user_pointer;
    if (!stepper && !(stepper = context->user_pointer = calloc(1, sizeof *stepper))) return NO_MEMORY;
    stepper->block = NULL;
    stepper->q = NULL;
    struct block *block = (struct block *)(uintptr_t)address;
    const int result = resolve(&stepper->bullet, arguments->text, block->missing);
    if (result == DONE) stepper->block = block;
    return result;
}

int initPlugin_t6gps(struct b3PluginContext *context) {
    context->user_pointer = NULL;
    return BULLET_API_VERSION;
}

void exitPlugin_t6gps(struct b3PluginContext *context) {
    free(context->user_pointer);
    context->user_pointer = NULL;
}

/* With integers it binds, without it makes one control step; the result is an enum result. */
int executePluginCommand_t6gps(struct b3PluginContext *context, const struct b3PluginArguments *arguments) {
    if (arguments->ints_n == 3) return bind(context, arguments);
    struct stepper *stepper = context->user_pointer;
    if (!stepper || !stepper->block) return NOT_BOUND;
    return control_step(stepper, context->client);
}
