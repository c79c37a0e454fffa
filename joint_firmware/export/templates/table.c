/* Parameters and gains of the drive of @joint.
 *
@origin
 */
#include "joint_law.h"

const joint_law_real @table[JOINT_LAW_PARAMETERS] = {
@values
};

@gain_sets
