// The policy in policy.onnx: its network by ONNX Runtime, and what its metadata says.

import * as ort from "./lib/onnxruntime-web/ort.js";

const numbers = (text, separator = ",") => text.split(separator).map(Number);
const rows = (text) => text.split(",").map((row) => numbers(row, ";"));

/**
 * Read the bytes of policy.onnx, and of ONNX Runtime's WebAssembly.
 * `J` joints, `O` numbers of observation; lengths m, angles rad, times s.
 */
export async function load(bytes, wasm) {
  const said = metadata(bytes);
  const widths = numbers(said.observation_widths);
  ort.env.wasm.numThreads = 1; // threads need headers that a plain file server does not send
  ort.env.wasm.wasmBinary = wasm;
  const session = await ort.InferenceSession.create(bytes, { executionProviders: ["wasm"] });
  return {
    // observation [O] -> actions [J]
    act: async (observation) => {
      const obs = new ort.Tensor("float32", Float32Array.from(observation), [1, observation.length]);
      return Array.from((await session.run({ obs })).actions.data);
    },
    terms: said.observation_names.split(",").map((name, i) => ({ name, width: widths[i] })),
    jointNames: said.joint_names.split(","),
    center: numbers(said.action_offset), // [J], the targets of action zero
    scale: numbers(said.action_scale), // [J], a unit of action
    jointAxes: rows(said.joint_axes), // [J][3]
    jointlessRow: said.jointless_row ? Number(said.jointless_row) : null,
    defaultQpos: numbers(said.default_qpos), // [7 + J]
    keyPoints: JSON.parse(said.key_points),
    fallShapes: JSON.parse(said.fall_shapes),
    stepTime: Number(said.step_dt),
    // Lowest and highest command forward and to the left (m/s) and of the turn (rad/s); null without commands.
    ranges: said.command_ranges ? rows(said.command_ranges) : null,
    average: Number(said.command_average ?? 0.5), // s, time constant of the running means of the velocity's errors
    errorScale: Number(said.command_error_scale ?? 0.3), // m/s and rad/s; a larger error counts by its logarithm
    history: Math.max(1, ...numbers(said.observation_terms_history_length)), // steps that each term is of
    said,
  };
}

/** The metadata of an ONNX file, text by key: ONNX Runtime Web does not tell it. */
export function metadata(bytes) {
  const text = new TextDecoder();
  const found = {};
  for (const [number, value] of fields(bytes)) {
    if (number !== 14) continue; // metadata_props of a ModelProto
    const pair = Object.fromEntries(fields(value));
    found[text.decode(pair[1])] = text.decode(pair[2] ?? new Uint8Array());
  }
  return found;
}

/** Numbers and values of a protobuf message's fields; bytes as views. */
function* fields(bytes) {
  let at = 0;
  const varint = () => {
    for (let value = 0, unit = 1; ; unit *= 128) {
      const byte = bytes[at++];
      if (byte === undefined) throw new Error("policy.onnx ends too early: expected an ONNX file");
      value += (byte & 127) * unit;
      if (byte < 128) return value;
    }
  };
  while (at < bytes.length) {
    const tag = varint();
    const number = Math.floor(tag / 8);
    const kind = tag % 8;
    if (kind === 0) yield [number, varint()];
    else if (kind === 1) at += 8;
    else if (kind === 5) at += 4;
    else if (kind === 2) {
      const length = varint();
      yield [number, bytes.subarray(at, (at += length))];
    } else throw new Error("policy.onnx has a field of an unknown kind: expected an ONNX file");
  }
}
