// The parts of an observation by name, as functions of a Simulation. fmpjax/sim2sim/observation.py has the same.

const column = (axes, i) => [axes[i], axes[3 + i], axes[6 + i]];

/** World vectors, one after another, in axes of which x points where the root faces. */
function heading(sim, vectors) {
  const [x, y] = sim.facing();
  const turned = [];
  for (let i = 0; i < vectors.length; i += 3) {
    const [a, b, c] = vectors.slice(i, i + 3);
    turned.push(a * x + b * y, b * x - a * y, c);
  }
  return turned;
}

/** First and last column of each hinge's rotation, row after row. */
function jointRotations(sim) {
  const { jointAxes, jointlessRow } = sim.policy;
  const found = jointAxes.map((axis, j) => {
    const cosine = Math.cos(sim.qpos[7 + j]);
    const sine = Math.sin(sim.qpos[7 + j]);
    const [x, y, z] = axis;
    const turned = [
      { unit: [1, 0, 0], cross: [0, z, -y], part: x },
      { unit: [0, 0, 1], cross: [y, -x, 0], part: z },
    ];
    return turned.flatMap(({ unit, cross, part }) =>
      unit.map((u, i) => cosine * (u - part * axis[i]) + sine * cross[i] + part * axis[i]),
    );
  });
  if (jointlessRow !== null) found.splice(jointlessRow, 0, [1, 0, 0, 0, 0, 1]);
  return found.flat();
}

const rotation = (sim) => [...column(sim.axes, 0), ...column(sim.axes, 2)];

export const TERMS = {
  root_height: (sim) => [sim.qpos[2]],
  root_rotation_6d: rotation,
  root_linear_velocity: (sim) => sim.qvel.slice(0, 3),
  root_angular_velocity: (sim) => sim.turning(),
  joint_position: (sim) => sim.qpos.slice(7),
  joint_rotation_6d: jointRotations,
  joint_velocity: (sim) => sim.qvel.slice(6),
  key_points: (sim) => sim.keyPoints(),
  heading_rotation_6d: (sim) => heading(sim, rotation(sim)),
  heading_linear_velocity: (sim) => heading(sim, sim.qvel.slice(0, 3)),
  heading_angular_velocity: (sim) => heading(sim, sim.turning()),
  heading_key_points: (sim) => heading(sim, sim.keyPoints()),
  base_ang_vel: (sim) => sim.qvel.slice(3, 6),
  projected_gravity: (sim) => sim.axes.slice(6, 9).map((x) => -x),
  velocity_commands: (sim) => sim.command,
  velocity_errors: (sim) => sim.errors,
  joint_pos: (sim) => sim.qpos.slice(7),
  joint_pos_rel: (sim) => sim.qpos.slice(7).map((angle, j) => angle - sim.policy.center[j]),
  joint_vel_rel: (sim) => sim.qvel.slice(6),
  last_action: (sim) => sim.action,
};
