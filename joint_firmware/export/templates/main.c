/* Example: the law on recorded pins.
 *
@origin
 *
 * Reads from standard input one step per line, counts and u separated by commas, lines that begin with # apart:
 *     @columns_in
 * A line "p INDEX VALUE" changes a parameter: a drive finds its motor_offset at power-on.
 * Prints one line per step, y and x, to the last digit:
 *     @columns_out
 * The argument chooses the joint; without one it is @default_joint.
 */
#include "joint_law.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static const struct {
    const char *joint;
    const joint_law_real *p;
} tables[] = {
@choices
};

static int numbers(const char *line, double *values, int n)
{
    int i;
    for (i = 0; i < n; i++) {
        char *end;
        values[i] = strtod(line, &end);
        if (end == line || (*end != ',' && *end != '\n' && *end != '\r' && *end != '\0'))
            return 0;
        if (*end == ',' && i + 1 < n)
            end++;
        line = end;
    }
    return *line != ',';
}

int main(int argc, char **argv)
{
    static joint_law law;
    static joint_law_real p[JOINT_LAW_PARAMETERS];
    static char line[1024];
    const size_t n = sizeof tables / sizeof tables[0];
    size_t which = 0;
    long row = 0;

    if (argc > 1 && argv[1][0] != '\0')
        for (which = 0; which < n && strcmp(argv[1], tables[which].joint) != 0; which++)
            ;
    if (which == n) {
        fprintf(stderr, "no joint %s\n", argv[1]);
        return 2;
    }
    memcpy(p, tables[which].p, sizeof p);
    joint_law_init(&law, p);
    while (fgets(line, sizeof line, stdin) != NULL) {
        double values[JOINT_LAW_COUNTS + JOINT_LAW_INPUTS];
        int32_t counts[JOINT_LAW_COUNTS];
        int i;

        row++;
        if (line[0] == '#')
            continue;
        if (line[0] == 'p') {
            double value;
            if (sscanf(line, "p %d %lf", &i, &value) != 2 || i < 0 || i >= JOINT_LAW_PARAMETERS) {
                fprintf(stderr, "line %ld: expected p INDEX VALUE\n", row);
                return 2;
            }
            p[i] = (joint_law_real)value;
            continue;
        }
        if (!numbers(line, values, JOINT_LAW_COUNTS + JOINT_LAW_INPUTS)) {
            fprintf(stderr, "line %ld: expected %d numbers\n", row, JOINT_LAW_COUNTS + JOINT_LAW_INPUTS);
            return 2;
        }
        for (i = 0; i < JOINT_LAW_COUNTS; i++)
            counts[i] = (int32_t)values[i];
        for (i = 0; i < JOINT_LAW_INPUTS; i++)
            law.u[i] = (joint_law_real)values[JOINT_LAW_COUNTS + i];
        joint_law_step(&law, counts);
        for (i = 0; i < JOINT_LAW_OUTPUTS; i++)
            printf("%.@{digits}g,", (double)law.y[i]);
        for (i = 0; i < JOINT_LAW_STATES; i++)
            printf("%.@{digits}g%c", (double)law.x[i], i + 1 < JOINT_LAW_STATES ? ',' : '\n');
    }
    return 0;
}
