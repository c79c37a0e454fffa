/* Control law of a joint's drive: what to call, and what every number means.
 *
@origin
 *
 * Use:
 *     static joint_law law;
 *     joint_law_init(&law, @first_table); // once; everything off
 *     joint_law_use(&law, &@first_gains); // gains, whenever they are to change
 *     law.u[JOINT_LAW_U_TORQUE_MODE] = 1; // ... when a command has come
 *     joint_law_step(&law, counts); // in the interrupt, at @rate Hz
 *     demand = (int32_t)law.y[JOINT_LAW_Y_DEMAND];
 *
 * The law closes the loop; output trips says what it has found wrong. State machine and watchdog are the firmware's
 * own: it must not pass a demand on to the power stage unless these allow it. The law looks at all the counts.
 *
 * In joint_law_step() nothing is repeated or left out depending on data: every call is the worst case, in operations
 * on joint_law_real:
@operations
 * Memory: @state_bytes bytes of joint_law (and a pointer), @parameter_bytes bytes of constants per joint, @work_bytes bytes of local variables.
 * Nothing is allocated, nothing is static. Of the library: @libm
 * (a compiler may use its memset and memcpy).
 *
 * Compiled without contraction of a * b + c (-ffp-contract=off) the outputs are @exactness.
 */
#ifndef JOINT_LAW_H
#define JOINT_LAW_H

#include <stdint.h>

#define JOINT_LAW_NAME "@law"
#define JOINT_LAW_VERSION "@version"
#define JOINT_LAW_FINGERPRINT "@fingerprint" /* of the law: equal ones compute the same */
#define JOINT_LAW_RATE_HZ @rate

typedef @real joint_law_real;

@enumerations

typedef struct {
    joint_law_real x[JOINT_LAW_STATES];  /* state, kept from step to step */
    joint_law_real u[JOINT_LAW_INPUTS];  /* what is asked for: yours to write between steps */
    joint_law_real y[JOINT_LAW_OUTPUTS]; /* what the last step computed: yours to read */
    const joint_law_real *p;             /* parameters; copy a table to RAM to change some, e.g. after a calibration */
} joint_law;

typedef struct {
@gain_fields
} joint_law_gains;

/* As after power-on, with all inputs zero: no current. p must stay where it is. */
void joint_law_init(joint_law *law, const joint_law_real p[JOINT_LAW_PARAMETERS]);

/* Gains from the next step on. */
void joint_law_use(joint_law *law, const joint_law_gains *gains);

/* One step: from the pins' counts, u and x to y and the next x. */
void joint_law_step(joint_law *law, const int32_t counts[JOINT_LAW_COUNTS]);

/* Parameters of each joint, and its gains. */
@tables

#endif
