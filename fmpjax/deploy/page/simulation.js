// The policy's robot in MuJoCo, one step of control at a time. fmpjax/sim2sim/simulation.py does the same.

import { TERMS } from "./observation.js";

const PUSH_SECONDS = 0.2;

/** Lengths m, angles rad, times s; rotations are row after row. `J` joints. */
export class Simulation {
  constructor(mujoco, xml, policy) {
    this.mujoco = mujoco;
    this.policy = policy;
    this.model = mujoco.MjModel.from_xml_string(xml);
    this.data = new mujoco.MjData(this.model);
    const model = this.model;
    this.joints = policy.jointNames.map((name) => this.#id("mjOBJ_JOINT", name));
    this.angles = this.joints.map((id) => model.jnt_qposadr[id]);
    this.rates = this.joints.map((id) => model.jnt_dofadr[id]);
    const driven = Array.from({ length: model.nu }, (_, i) => model.actuator_trnid[2 * i]);
    this.servos = this.joints.map((id) => driven.indexOf(id));
    this.free = Array.from(model.jnt_type).indexOf(0);
    this.root = model.jnt_bodyid[this.free];
    this.substeps = Math.max(1, Math.round(policy.stepTime / model.opt.timestep));
    this.points = policy.keyPoints.map((p) => ({ body: this.#body(p), offset: p.offset }));
    this.shapes = policy.fallShapes.map((s) => ({ body: this.#body(s), ends: s.ends, radius: s.radius }));
    this.command = [0, 0, 0];
    this.reset();
    for (const { name, width } of policy.terms) {
      const found = policy.history * TERMS[name]?.(this).length;
      if (found !== width) throw new Error(`the policy observes ${width} numbers of ${name}: the page makes ${found}`);
    }
  }

  #id(kind, name) {
    const id = this.mujoco.mj_name2id(this.model, this.mujoco.mjtObj[kind].value, name);
    if (id < 0) throw new Error(`model.xml has no ${name}: the policy moves ${this.policy.said.robot}`);
    return id;
  }

  #body(place) {
    if (place.joint !== null) return this.model.jnt_bodyid[this.#id("mjOBJ_JOINT", place.joint)];
    return this.#id("mjOBJ_BODY", place.body);
  }

  /** The policy's default pose at rest. The command stays. */
  reset() {
    const { mujoco, model, data, policy } = this;
    mujoco.mj_resetData(model, data);
    const root = model.jnt_qposadr[this.free];
    policy.defaultQpos.slice(0, 7).forEach((x, i) => (data.qpos[root + i] = x));
    this.angles.forEach((at, j) => (data.qpos[at] = policy.defaultQpos[7 + j]));
    mujoco.mj_kinematics(model, data);
    this.action = policy.center.map(() => 0);
    this.errors = [0, 0, 0]; // running mean of velocity less command: m/s, m/s, rad/s
    this.past = []; // what was sensed at earlier steps, the oldest first
    this.fallen = false;
    this.force = null; // [3] N in the world
    this.pushedUntil = 0;
    this.#read();
  }

  /** Positions and velocities in the policy's order. */
  #read() {
    const { model, data } = this;
    const [root, dof] = [model.jnt_qposadr[this.free], model.jnt_dofadr[this.free]];
    const [qpos, qvel] = [data.qpos, data.qvel]; // each access makes a view
    this.qpos = [...qpos.slice(root, root + 7), ...this.angles.map((at) => qpos[at])];
    this.qvel = [...qvel.slice(dof, dof + 6), ...this.rates.map((at) => qvel[at])];
    this.axes = Array.from(data.xmat.slice(9 * this.root, 9 * this.root + 9));
    this.place = Array.from(data.xpos.slice(3 * this.root, 3 * this.root + 3));
  }

  get time() {
    return this.data.time;
  }

  /** Where the root faces, a unit vector in the floor, [2]. */
  facing() {
    const [x, y] = [this.axes[0], this.axes[3]];
    const length = Math.max(Math.hypot(x, y), 1e-6);
    return [x / length, y / length];
  }

  /** The root's angular velocity in the world, [3]. */
  turning() {
    const own = this.qvel.slice(3, 6);
    return [0, 3, 6].map((i) => this.axes[i] * own[0] + this.axes[i + 1] * own[1] + this.axes[i + 2] * own[2]);
  }

  /** Key points less the root, in the world's axes, one after another. */
  keyPoints() {
    const [places, axes] = [this.data.xpos, this.data.xmat];
    return this.points.flatMap(({ body, offset }) => point(places, axes, body, offset).map((x, i) => x - this.place[i]));
  }

  /** The policy's observation; ahead of the first steps stands the first again. */
  observe() {
    const { terms, history } = this.policy;
    const newest = this.#sensed();
    const before = [...Array(history).fill(this.past[0] ?? newest), ...this.past];
    const every = [...before, newest].slice(-history);
    return terms.flatMap((_, i) => every.flatMap((step) => step[i]));
  }

  /** The parts of the observation of this step alone. */
  #sensed() {
    return this.policy.terms.map(({ name }) => Array.from(TERMS[name](this)));
  }

  /** Push the root for a moment: `force` [2] in N, forward and to the left of the robot. */
  push([forward, left]) {
    const [x, y] = this.facing();
    this.force = [forward * x - left * y, forward * y + left * x, 0];
    this.pushedUntil = this.time + PUSH_SECONDS;
  }

  /** One step of control. `fallen` says afterwards whether the robot has fallen since the reset. */
  async step() {
    const { mujoco, model, data, policy } = this;
    const observation = this.observe();
    if (policy.history > 1) this.past = [...this.past, this.#sensed()].slice(1 - policy.history);
    this.action = await policy.act(observation);
    if (this.force && this.time > this.pushedUntil - 1e-9) this.force = null;
    const [control, applied] = [data.ctrl, data.xfrc_applied];
    this.servos.forEach((at, j) => (control[at] = policy.center[j] + policy.scale[j] * this.action[j]));
    for (let i = 0; i < 3; i++) applied[6 * this.root + i] = this.force?.[i] ?? 0;
    for (let i = 0; i < this.substeps; i++) mujoco.mj_step(model, data);
    if (!data.qpos.every(Number.isFinite)) {
      this.fallen = true;
      return;
    }
    mujoco.mj_kinematics(model, data);
    this.#read();
    const newest = Math.min(1, policy.stepTime / policy.average);
    const velocity = this.velocity();
    const counted = (i) => {
      const off = velocity[i] - this.command[i];
      return Math.sign(off) * policy.errorScale * Math.log1p(Math.abs(off) / policy.errorScale);
    };
    this.errors = this.errors.map((error, i) => error + newest * (counted(i) - error));
    const [places, axes] = [data.xpos, data.xmat];
    this.fallen ||= this.shapes.some(({ body, ends, radius }) =>
      ends.some((end) => point(places, axes, body, end)[2] < radius),
    );
  }

  /** Velocity of the root forward and to the left in its own heading (m/s), and its turn (rad/s), [3]. */
  velocity() {
    const [x, y] = this.facing();
    const [vx, vy] = this.qvel;
    return [x * vx + y * vy, x * vy - y * vx, this.turning()[2]];
  }
}

/** A point of a body in the world, [3]. */
function point(places, axes, body, offset) {
  return [0, 1, 2].map((i) => {
    const row = 9 * body + 3 * i;
    return places[3 * body + i] + axes[row] * offset[0] + axes[row + 1] * offset[1] + axes[row + 2] * offset[2];
  });
}
