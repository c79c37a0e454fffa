/* Control law of a joint's drive.
 *
@origin
 */
#include "joint_law.h"

#include <math.h>

@{helpers}void joint_law_init(joint_law *law, const joint_law_real p[JOINT_LAW_PARAMETERS])
{
    int i;
    for (i = 0; i < JOINT_LAW_STATES; i++)
        law->x[i] = 0;
    for (i = 0; i < JOINT_LAW_INPUTS; i++)
        law->u[i] = 0;
    for (i = 0; i < JOINT_LAW_OUTPUTS; i++)
        law->y[i] = 0;
    law->p = p;
}

void joint_law_use(joint_law *law, const joint_law_gains *gains)
{
@use_gains
}

/* One operation per statement, in the order in which they were tested: no compiler may round in between. */
void joint_law_step(joint_law *law, const int32_t counts[JOINT_LAW_COUNTS])
{
    const joint_law_real *const u = law->u, *const p = law->p;
    joint_law_real *const x = law->x, *const y = law->y;
    joint_law_real next[JOINT_LAW_STATES];
@work
    int i;

@statements

    for (i = 0; i < JOINT_LAW_STATES; i++)
        x[i] = next[i];
}
