// The page: it loads the policy, runs it in real time, and hands commands and pushes to it.

import loadMujoco from "./lib/mujoco/mujoco.js";
import { load } from "./policy.js";
import { Simulation } from "./simulation.js";
import { View } from "./view.js";

const LONGEST = 0.25; // s, that a frame makes up for at most: a slow machine gets a slow robot
const COMMANDS = [
  { label: "forward", unit: "m/s", keys: ["KeyS", "KeyW"] },
  { label: "left", unit: "m/s", keys: ["KeyE", "KeyQ"] },
  { label: "turn", unit: "rad/s", keys: ["KeyD", "KeyA"] },
];
const PUSHES = { ArrowUp: [1, 0], ArrowDown: [-1, 0], ArrowLeft: [0, 1], ArrowRight: [0, -1] };
const NARROW = 0.05; // m/s or rad/s: a range below it is that of a training that did not vary this part
const KEY_PARTS = 5; // key presses from zero to the end of a range

const $ = (id) => document.getElementById(id);

async function bytes(name) {
  const answer = await fetch(new URL(name, import.meta.url));
  if (!answer.ok) throw new Error(`${name} cannot be loaded: the server says ${answer.status}`);
  return new Uint8Array(await answer.arrayBuffer());
}

class Page {
  constructor(sim) {
    this.sim = sim;
    this.view = new View($("view"), sim);
    this.paused = false;
    this.resetting = false;
    this.stepping = false;
    this.pace = 1;
    this.falls = 0;
    this.fellAt = null; // s, of the simulation
    this.recent = []; // velocities of the last second
    this.sliders = [];
    this.rates = { simulated: 0, real: 0, shown: 1 };
    this.#describe();
    this.#commands();
    this.#buttons();
    addEventListener("keydown", (event) => this.#key(event));
  }

  #describe() {
    const { said } = this.sim.policy;
    document.title = $("title").textContent = said.run_path || said.robot;
    $("about").textContent = `${said.robot}, trained by ${said.method}, ${Math.round(1 / this.sim.policy.stepTime)} Hz`;
  }

  /** A slider for each part of the command that the policy was trained to obey. */
  #commands() {
    const { ranges, terms } = this.sim.policy;
    if (!ranges || !terms.some(({ name }) => name === "velocity_commands")) return;
    $("commands").hidden = false;
    this.sliders = COMMANDS.map(({ label, unit }, i) => {
      const [low, high] = ranges[i];
      if (high - low < NARROW) return null;
      const row = Object.assign(document.createElement("label"), { className: "slider" });
      const slider = Object.assign(document.createElement("input"), { type: "range", min: low, max: high, step: 0.01 });
      const value = document.createElement("output");
      slider.id = `command-${label}`;
      slider.addEventListener("input", () => this.tell(i, Number(slider.value)));
      row.append(label, slider, value);
      $("stop").before(row);
      return { slider, value, unit, low, high };
    });
    this.stop();
  }

  /** Command part `i` of the velocity, kept within its range. */
  tell(i, value) {
    const part = this.sliders[i];
    if (!part) return;
    const told = Math.min(Math.max(value, part.low), part.high);
    this.sim.command[i] = told;
    part.slider.value = told;
    part.value.textContent = `${told.toFixed(2)} ${part.unit}`;
  }

  stop() {
    this.sliders.forEach((_, i) => this.tell(i, 0));
  }

  push(direction) {
    const force = Number($("force").value);
    this.sim.push(direction.map((x) => force * x));
  }

  /** Put the robot back at its start, as soon as no step is under way. */
  reset() {
    this.resetting = true;
  }

  #restart() {
    this.sim.reset();
    this.recent = [];
    this.fellAt = null;
    this.resetting = false;
  }

  pause(paused = !this.paused) {
    this.paused = paused;
    $("pause").textContent = paused ? "Go on" : "Pause";
  }

  #buttons() {
    const force = () => ($("force-value").textContent = `${$("force").value} N`);
    const handlers = { pause: () => this.pause(), reset: () => this.reset(), stop: () => this.stop() };
    for (const [id, act] of Object.entries(handlers)) $(id).addEventListener("click", act);
    for (const button of document.querySelectorAll("[data-push]")) {
      button.addEventListener("click", () => this.push(button.dataset.push.split(",").map(Number)));
    }
    $("force").addEventListener("input", force);
    $("pace").addEventListener("change", () => (this.pace = Number($("pace").value)));
    $("shapes").addEventListener("change", () => this.view.showShapes($("shapes").checked));
    force();
  }

  #key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.code.startsWith("Arrow") && event.target.matches("input, select")) return; // they move its slider
    if (event.code === "Space" && event.target.matches("button, input, select")) return; // it presses that one
    const part = COMMANDS.findIndex(({ keys }) => keys.includes(event.code));
    if (part >= 0 && this.sliders[part]) {
      const { low, high } = this.sliders[part];
      const step = (Math.max(Math.abs(low), high) / KEY_PARTS) * (COMMANDS[part].keys[1] === event.code ? 1 : -1);
      const next = this.sim.command[part] + step;
      this.tell(part, next * this.sim.command[part] < 0 || Math.abs(next) < 1e-9 ? 0 : next); // no key jumps over zero
    } else if (PUSHES[event.code]) this.push(PUSHES[event.code]);
    else if (event.code === "Space") this.pause();
    else if (event.code === "KeyR") this.reset();
    else if (event.code === "KeyX") this.stop();
    else return;
    event.preventDefault();
  }

  /** One step of control, and what follows from it. */
  async step() {
    const { sim } = this;
    const stood = !sim.fallen;
    this.stepping = true;
    await sim.step();
    this.stepping = false;
    this.recent.push(sim.velocity());
    if (this.recent.length * sim.policy.stepTime > 1) this.recent.shift();
    if (sim.fallen && stood) {
      this.falls += 1;
      this.fellAt = sim.time;
    }
    const blown = !sim.data.qpos.every(Number.isFinite);
    const over = sim.fallen && $("rise").checked && sim.time > this.fellAt + 1;
    if (this.resetting || blown || over) this.#restart();
  }

  /** Mean velocity of the last second forward and to the left (m/s), and its turn (rad/s). */
  velocity() {
    return [0, 1, 2].map((i) => this.recent.reduce((sum, v) => sum + v[i], 0) / Math.max(this.recent.length, 1));
  }

  #measure() {
    const [forward, left, turn] = this.velocity();
    $("time").textContent = `${this.sim.time.toFixed(1)} s`;
    $("forward").textContent = `${forward.toFixed(2)} m/s`;
    $("left").textContent = `${left.toFixed(2)} m/s`;
    $("turn").textContent = `${turn.toFixed(2)} rad/s`;
    $("falls").textContent = this.falls;
    $("rate").textContent = this.paused ? "paused" : `${this.rates.shown.toFixed(2)} ×`;
  }

  /** Run and draw until the page is closed. */
  async run() {
    let last = performance.now();
    let owed = 0;
    for (;;) {
      const now = await new Promise(requestAnimationFrame);
      const passed = Math.max(now - last, 0) / 1000;
      last = now;
      if (this.resetting) this.#restart();
      if (!this.paused) {
        owed += Math.min(passed, LONGEST) * this.pace;
        const { stepTime } = this.sim.policy;
        for (; owed >= stepTime && !this.paused; owed -= stepTime) {
          await this.step();
          this.rates.simulated += stepTime;
        }
        this.rates.real += passed;
      }
      if (this.rates.real > 1) this.rates = { simulated: 0, real: 0, shown: this.rates.simulated / this.rates.real };
      this.view.draw();
      this.#measure();
    }
  }
}

function fail(error) {
  console.error(error);
  $("message").hidden = false;
  $("message").className = "error";
  $("message").textContent = `The page cannot run: ${error.message ?? error}`;
}

async function start() {
  $("message").textContent = "Loading MuJoCo and the policy ...";
  const names = ["lib/onnxruntime-web/ort.wasm", "policy.onnx", "model.xml"];
  const [mujoco, wasm, onnx, xml] = await Promise.all([loadMujoco(), ...names.map(bytes)]);
  const policy = await load(onnx, wasm);
  const page = new Page(new Simulation(mujoco, new TextDecoder().decode(xml), policy));
  $("message").hidden = true;
  $("controls").hidden = false;
  globalThis.page = page; // for the browser's console and for scripts
  await page.run();
}

start().catch(fail);
