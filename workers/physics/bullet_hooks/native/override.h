/* Functions of ours in the place of virtual functions of Bullet. */
#ifndef T6GPS_OVERRIDE_H
#define T6GPS_OVERRIDE_H

/*
 * Puts `ours` in the place of `expected` in a class's table of virtual functions, once in a process. Returns 0, and
 * changes nothing, if the table has no such entry among its first 32.
 */
int override(void **table, void *expected, void *ours);

#endif
