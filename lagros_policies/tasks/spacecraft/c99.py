"""A spacecraft policy as one C99 file: what one agent senses to the forces of its thrusters.

Features, deep set, the turns into the body's axes and the allocation of thrusters, in float; no
dependency but `sqrtf` and `expf`. The bodies that are sensed are taken one after the other and
added up, so that their number has no limit and costs no memory.
"""

from __future__ import annotations

import numpy as np

from lagros_policies.export.c_layers import Activation, array, layer, literal
from lagros_policies.export.source import SpacecraftSource
from lagros_policies.tasks.spacecraft import features
from lagros_policies.tasks.spacecraft.features import NEIGHBOUR, OBSTACLE, OWN
from lagros_policies.tasks.spacecraft.pace import CRUISE_SPEED, LEAST_TIME
from lagros_policies.tasks.spacecraft.thrusters import allocation_matrix

_SAMPLES = 8  # of the self-test


def spacecraft_source(source: SpacecraftSource) -> str:
    """Return the C99 file of a spacecraft policy: all of u_L(o_l) of one agent.

    It defines `void NAME_thrust(own, neighbours, neighbour_count, obstacles, obstacle_count,
    thrust)` and `void NAME_observation(observation, neighbour_slots, obstacle_slots, thrust)`,
    which write the eight forces u >= 0 [N], with NAME the policy's, and with -DLAGROS_SELF_TEST a
    `main` that compares with stored forces.

    Args:
        source: The policy.
    """
    name = source.name.replace("-", "_")
    return "\n".join(
        [
            _header(source, name),
            _constants(source),
            *_network(source),
            _SENSED,
            _ANSWER,
            _interface(name),
            _self_test(source, name),
        ]
    )


def _header(source: SpacecraftSource, name: str) -> str:
    widths = {
        part: "-".join(
            str(width) for width in [len(layers[0][0]), *(len(bias) for _, bias in layers)]
        )
        for part, layers in source.network.layers.items()
    }
    return f"""/*
 * {source.name}: the thrusters of one spacecraft. C99, one file, no heap, no state.
 *
 *     void {name}_thrust(const float own[9],
 *                        const float *neighbours, int neighbour_count,
 *                        const float *obstacles, int obstacle_count, float thrust[8]);
 *     void {name}_observation(const float *observation, int neighbour_slots,
 *                             int obstacle_slots, float thrust[8]);
 *
 * own          what the agent knows of itself: goal relative to it x, y [m]; velocity x, y [m/s];
 *              cos and sin of its heading; turn of the heading since the start [rad]; spin [rad/s];
 *              time since the start of the episode [s]
 * neighbours   four for each agent that is sensed: position x, y [m] and velocity x, y [m/s],
 *              relative to the agent, in the world's axes; in any order
 * obstacles    three for each that is sensed: centre x, y relative to the agent [m], radius [m]
 * observation  as lagros/Spacecraft-v0 gives it, 9 + 5 neighbour_slots + 4 obstacle_slots numbers
 * thrust       written: u >= 0 of the eight thrusters [N]; hold it for one control step of 0.1 s.
 *              A NaN in any number that is read, a mask included, makes all eight NaN; compile
 *              without -ffast-math and -Ofast, which take it that there is none
 *
 * Bodies that would not be sensed have no influence: agents whose centre, and obstacles of which
 * every part, is farther than REACH. No safety filter is included.
 * Network, a deep set with ReLU: neighbours {widths["neighbour"]}, obstacles {widths["obstacle"]},
 * agent {widths["agent"]}.
 * Weights: {source.file}, SHA-256
 *     {source.digest}
 * Self-test: cc -std=c99 -O2 -DLAGROS_SELF_TEST THIS_FILE -lm && ./a.out
 * Written by `lagros export`; do not edit.
 */
#include <math.h>

void {name}_thrust(const float own[9], const float *neighbours, int neighbour_count,
                   const float *obstacles, int obstacle_count, float thrust[8]);
void {name}_observation(const float *observation, int neighbour_slots,
                        int obstacle_slots, float thrust[8]);
"""


def _constants(source: SpacecraftSource) -> str:
    settings, body = source.policy.settings, source.policy.settings.system
    agent_radius, core_radius = source.radii
    first, second = _widths(source)
    numbers = {
        "TOUCH": (2.0 * agent_radius, "distance of two agents' centres at touch [m]"),
        "CORE": (core_radius, "radius of the agent against obstacles [m]"),
        "REACH": (settings.sensing_radius, "how far the agent senses [m]"),
        "FADE": (features.FADE, "what is sensed counts in full this far inside [m]"),
        "NEAR": (features.NEAR, "scale of nearness [m]"),
        "HORIZON": (settings.horizon, "nominal duration of a flight [s]"),
        "CRUISE": (CRUISE_SPEED, "mean speed that nobody has to exceed [m/s]"),
        "LEAST_TIME": (LEAST_TIME, "[s]"),
        "CLOSE": (
            features.CLOSE,
            "distance beyond which one feature stays [m]",
        ),
        "SOON": (features.SOON, "time beyond which one feature stays [s]"),
        "SMALL": (features.SMALL, "keeps divisors from zero [m]"),
        "MASS": (body.mass, "[kg]"),
        "TWICE_INERTIA": (2.0 * body.inertia, "[kg m^2]"),
    }
    widths = {"OWN": len(OWN), "FIRST": first, "SECOND": second}
    return "\n".join(
        [
            *(f"#define {key} {literal(value)} /* {value:g}: {what} */"
              for key, (value, what) in numbers.items()),
            *(f"#define {key} {value}" for key, value in widths.items()),
            "",
            "/* Forces along the body's axes and torque to the eight thrusters, three rows. */",
            array("allocation", allocation_matrix(body).astype(np.float32)),
        ]
    )  # fmt: skip


def _network(source: SpacecraftSource) -> list[str]:
    """Return the layers and, for each part, a function that runs through them."""
    code = []
    for part, layers in source.network.layers.items():
        last = len(layers) - 1
        names = ["input", *(f"hidden{index}" for index in range(last)), "output"]
        memory, calls = [], []
        for index, (weight, bias) in enumerate(layers):
            linear = part == "agent" and index == last
            activation: Activation = "none" if linear else "relu"
            code.append(layer(f"{part}{index}", weight, bias, activation))
            calls.append(f"    {part}{index}({names[index]}, {names[index + 1]});")
            if index < last:
                memory.append(f"    float {names[index + 1]}[{len(bias)}];")
        head = f"static void {part}(const float *restrict input, float *restrict output)"
        code.append("\n".join([head, "{", *memory, *calls, "}", ""]))
    return code


def _widths(source: SpacecraftSource) -> tuple[int, int]:
    layers = source.network.layers
    return len(layers["neighbour"][-1][1]), len(layers["obstacle"][-1][1])


_SENSED = f"""/* What is sensed, in the frame whose first axis points to the goal. */
struct view {{
    float ahead[2];             /* that axis, in the world */
    float velocity[2];          /* of the agent, in the world [m/s] */
    float inputs[OWN + FIRST + SECOND];
}};

/* A vector of the world in the frame of an axis. */
static void turn_back(const float axis[2], const float vector[2], float turned[2])
{{
    turned[0] = vector[0] * axis[0] + vector[1] * axis[1];
    turned[1] = vector[1] * axis[0] - vector[0] * axis[1];
}}

static void look(const float own[9], struct view *view)
{{
    const float goal[2] = {{own[0] + SMALL, own[1]}};
    const float distance = sqrtf(goal[0] * goal[0] + goal[1] * goal[1]);
    float *inputs = view->inputs;
    float left = HORIZON - own[8];
    int i;
    left = left < LEAST_TIME ? LEAST_TIME : left;
    left = left < distance / CRUISE ? distance / CRUISE : left;
    view->ahead[0] = goal[0] / distance;
    view->ahead[1] = goal[1] / distance;
    view->velocity[0] = own[2];
    view->velocity[1] = own[3];
    inputs[0] = distance;
    inputs[1] = distance > CLOSE ? CLOSE : distance;
    turn_back(view->ahead, view->velocity, inputs + 2);
    inputs[4] = left;
    inputs[5] = left > SOON ? SOON : left;
    inputs[6] = distance / (left + SOON);
    inputs[7] = own[6];
    inputs[8] = own[7];
    for (i = OWN; i < OWN + FIRST + SECOND; i++)
        inputs[i] = 0.0f;
}}

/* The features of a body, given where it is, how it moves against the agent, the distance of the
 * centres at touch and the one at which it is lost from sight. Returns how much it counts. */
static float body_features(const struct view *view, const float place[2], const float motion[2],
                           float touch, float rim, float values[{len(OBSTACLE)}])
{{
    float apart[2], centre, gap, weight;
    turn_back(view->ahead, place, apart);
    centre = sqrtf(apart[0] * apart[0] + apart[1] * apart[1]) + SMALL;
    gap = centre - touch;
    values[0] = apart[0] / centre;
    values[1] = apart[1] / centre;
    values[2] = gap;
    /* Deep inside another body nearness would explode. */
    values[3] = expf((gap < -NEAR ? -NEAR : gap) / -NEAR);
    turn_back(view->ahead, motion, values + 4);
    values[6] = -(values[0] * values[4] + values[1] * values[5]);
    values[7] = touch;
    weight = (rim - centre) / FADE;
    weight = weight > 1.0f ? 1.0f : weight;
    return weight < 0.0f ? 0.0f : weight;
}}

static void see_neighbour(struct view *view, const float body[4])
{{
    float values[{len(OBSTACLE)}], outputs[FIRST];
    const float weight = body_features(view, body, body + 2, TOUCH, REACH, values);
    float *sums = view->inputs + OWN;
    int i;
    neighbour(values, outputs); /* its {len(NEIGHBOUR)} inputs: all but the last */
    for (i = 0; i < FIRST; i++)
        sums[i] += weight * outputs[i];
}}

static void see_obstacle(struct view *view, const float disc[3])
{{
    const float motion[2] = {{-view->velocity[0], -view->velocity[1]}};
    float values[{len(OBSTACLE)}], outputs[SECOND];
    const float weight =
        body_features(view, disc, motion, disc[2] + CORE, disc[2] + REACH, values);
    float *sums = view->inputs + OWN + FIRST;
    int i;
    obstacle(values, outputs);
    for (i = 0; i < SECOND; i++)
        sums[i] += weight * outputs[i];
}}
"""

_ANSWER = """/* The network's acceleration, turned into the world's axes and then the body's. */
static void answer(const struct view *view, const float own[9], float thrust[8])
{
    float acceleration[3], wrench[3], world[2];
    int i;
    agent(view->inputs, acceleration);
    world[0] = acceleration[0] * view->ahead[0] - acceleration[1] * view->ahead[1];
    world[1] = acceleration[1] * view->ahead[0] + acceleration[0] * view->ahead[1];
    wrench[0] = MASS * (world[0] * own[4] - world[1] * own[5]);
    wrench[1] = MASS * (world[1] * own[4] + world[0] * own[5]);
    wrench[2] = TWICE_INERTIA * acceleration[2];
    for (i = 0; i < 8; i++) {
        const float force = wrench[0] * allocation[i] + wrench[1] * allocation[8 + i]
                            + wrench[2] * allocation[16 + i];
        thrust[i] = force < 0.0f ? 0.0f : force;
    }
}
"""


def _interface(name: str) -> str:
    return f"""void {name}_thrust(const float own[9], const float *neighbours, int neighbour_count,
                   const float *obstacles, int obstacle_count, float thrust[8])
{{
    struct view view;
    int i;
    look(own, &view);
    for (i = 0; i < neighbour_count; i++)
        see_neighbour(&view, neighbours + 4 * i);
    for (i = 0; i < obstacle_count; i++)
        see_obstacle(&view, obstacles + 3 * i);
    answer(&view, own, thrust);
}}

void {name}_observation(const float *observation, int neighbour_slots,
                        int obstacle_slots, float thrust[8])
{{
    const float *neighbours = observation + 9;
    const float *neighbour_mask = neighbours + 4 * neighbour_slots;
    const float *obstacles = neighbour_mask + neighbour_slots;
    const float *obstacle_mask = obstacles + 3 * obstacle_slots;
    struct view view;
    int i;
    look(observation, &view);
    /* Zero times the mask: a NaN there must not hide a body. */
    for (i = 0; i < neighbour_slots; i++)
        if (neighbour_mask[i] > 0.0f)
            see_neighbour(&view, neighbours + 4 * i);
        else
            view.inputs[OWN] += 0.0f * neighbour_mask[i];
    for (i = 0; i < obstacle_slots; i++)
        if (obstacle_mask[i] > 0.0f)
            see_obstacle(&view, obstacles + 3 * i);
        else
            view.inputs[OWN] += 0.0f * obstacle_mask[i];
    answer(&view, observation, thrust);
}}
"""


def _self_test(source: SpacecraftSource, name: str) -> str:
    observations = source.examples(_SAMPLES)
    thrusts = source.answer(observations)
    layout = source.layout
    return f"""#ifdef LAGROS_SELF_TEST
#include <stdio.h>

/* Thrusts by NumPy; single precision and another order of summation move the last digits. */
{array("test_observations", observations)}
{array("test_thrusts", thrusts)}
#define TOLERANCE {literal(1e-5 * float(thrusts.max()))} /* 1e-5 of the largest [N] */

int main(void)
{{
    int i, j, failures = 0;
    for (i = 0; i < {_SAMPLES}; i++) {{
        float thrust[8];
        int agrees = 1;
        {name}_observation(test_observations + {layout.size} * i, {layout.neighbours},
                           {layout.obstacles}, thrust);
        for (j = 0; j < 8; j++) {{
            const float wanted = test_thrusts[8 * i + j];
            const float error = thrust[j] > wanted ? thrust[j] - wanted : wanted - thrust[j];
            /* Written so that a NaN fails. */
            if (!(error <= TOLERANCE)) {{
                printf("case %d, thruster %d: %.7g N, wanted %.7g N\\n", i, j, (double)thrust[j],
                       (double)wanted);
                agrees = 0;
            }}
        }}
        failures += !agrees;
    }}
    printf("%d of {_SAMPLES} cases agree\\n", {_SAMPLES} - failures);
    return failures != 0;
}}
#endif
"""
