/** A recording of telemetry, and its approximation by few keyframes. */
import { signal, type ReadonlySignal } from "@preact/signals-core";
import { startAtZero, poseOf, normalize, type Keyframe, type Movement, type Positions, type Robot } from "./keyframes";
import type { KnownEvent, KnownTelemetry } from "../../../shared/mqtt/parse-messages";

export interface Sample {
  /** Since the start [s]. */
  time_s: number;
  position_rad: readonly number[];
}

/** No telemetry arrived between these times [s]; the motion is interpolated. */
interface Gap {
  from_s: number;
  to_s: number;
}

export interface Recording {
  samples: readonly Sample[];
  gaps: readonly Gap[];
  speech: readonly { time_s: number; text: string }[];
}

const EMPTY: Recording = { samples: [], gaps: [], speech: [] };
/** Five samples at 20 Hz. */
const GAP_S = 0.25;
/** Twenty minutes at 20 Hz. */
const MAX_SAMPLES = 24_000;

export class Recorder {
  readonly #recording = signal<Recording>(EMPTY);
  readonly #running = signal(false);
  #samples: Sample[] = [];
  #gaps: Gap[] = [];
  #speech: { time_s: number; text: string }[] = [];
  #last: KnownTelemetry | null = null;

  readonly recording: ReadonlySignal<Recording> = this.#recording;
  readonly running: ReadonlySignal<boolean> = this.#running;

  start(): void {
    [this.#samples, this.#gaps, this.#speech, this.#last] = [[], [], [], null];
    this.#running.value = true;
    this.#publish();
  }

  stop(): void {
    this.#running.value = false;
    this.#publish();
  }

  /** Uses the robot's clock; after its restart, the wall clock. */
  addTelemetry(message: KnownTelemetry): void {
    if (!this.#running.value || message === this.#last) return;
    const last = this.#last;
    const ticks = last === null ? 0 : message.tick_ms - last.tick_ms;
    const elapsed_s = last === null ? 0 : (ticks > 0 ? ticks : Math.max(1, message.at_ms - last.at_ms)) / 1000;
    const before = this.#samples.at(-1)?.time_s ?? 0;
    const time_s = before + elapsed_s;
    if (elapsed_s > GAP_S) this.#gaps.push({ from_s: before, to_s: time_s });
    this.#samples.push({ time_s, position_rad: message.position_rad });
    this.#last = message;
    if (this.#samples.length >= MAX_SAMPLES) this.stop();
    else if (this.#samples.length % 10 === 0 || last === null) this.#publish();
  }

  addEvent(event: KnownEvent): void {
    const text = event.data["text"];
    if (!this.#running.value || event.kind !== "speech-started" || typeof text !== "string" || this.#last === null) return;
    const started_ms = this.#last.at_ms - (this.#samples.at(-1)?.time_s ?? 0) * 1000;
    this.#speech.push({ time_s: Math.max(0, (event.at_ms - started_ms) / 1000), text });
    this.#publish();
  }


  clear(): void {
    this.#recording.value = EMPTY;
  }

  #publish(): void {
    this.#recording.value = { samples: [...this.#samples], gaps: [...this.#gaps], speech: [...this.#speech] };
  }
}

/** The part between two times, starting at 0. */
export function trim(recording: Recording, from_s: number, to_s: number): Recording {
  const within = (time: number): boolean => time >= from_s && time <= to_s;
  return {
    samples: recording.samples.filter(({ time_s }) => within(time_s)),
    gaps: recording.gaps.filter((gap) => within(gap.from_s) && within(gap.to_s)),
    speech: recording.speech.filter(({ time_s }) => within(time_s)),
  };
}

/** Indices of samples such that all others are within the tolerance of the lines between them (Ramer–Douglas–Peucker). */
export function simplify(samples: readonly Sample[], toleranceRad: number, always: ReadonlySet<number>): number[] {
  const found = new Set([0, samples.length - 1, ...always]);
  const open = pairs([...found].sort((a, b) => a - b));
  for (let pair = open.pop(); pair !== undefined; pair = open.pop()) {
    const [begin, end] = pair;
    let worst = { index: -1, deviation: toleranceRad };
    for (let index = begin + 1; index < end; index += 1) {
      const deviation = deviationFromLine(samples, begin, end, index);
      if (deviation > worst.deviation) worst = { index, deviation };
    }
    if (worst.index < 0) continue;
    found.add(worst.index);
    open.push([begin, worst.index], [worst.index, end]);
  }
  return [...found].filter((index) => index >= 0).sort((a, b) => a - b);
}

function pairs(list: readonly number[]): [number, number][] {
  return list.slice(1).map((one, index) => [list[index] ?? 0, one]);
}

/** Maximum joint distance of a sample from the line between two others [rad]. */
function deviationFromLine(samples: readonly Sample[], begin: number, end: number, index: number): number {
  const [from, to, one] = [samples[begin], samples[end], samples[index]];
  if (from === undefined || to === undefined || one === undefined) return 0;
  const share = (one.time_s - from.time_s) / (to.time_s - from.time_s);
  return one.position_rad.reduce((most, position, joint) => {
    const [a, b] = [from.position_rad[joint] ?? position, to.position_rad[joint] ?? position];
    return Math.max(most, Math.abs(position - (a + share * (b - a))));
  }, 0);
}

/** Keyframes within `toleranceRad` of the recording. Joints without motion occur once. */
export function keyframesOf(recording: Recording, toleranceRad: number, robot: Robot): Keyframe[] {
  const { samples } = recording;
  if (samples.length === 0) return [];
  const edges = new Set(recording.gaps.flatMap(({ from_s, to_s }) => [indexAt(samples, from_s), indexAt(samples, to_s)]));
  const speechByIndex = new Map(recording.speech.map(({ time_s, text }) => [indexAt(samples, time_s), text]));
  const indices = simplify(samples, toleranceRad, new Set([...edges, ...speechByIndex.keys()]));
  const movingJoints = robot.joints.filter((_, joint) => {
    const positions = samples.map(({ position_rad }) => position_rad[joint] ?? 0);
    return Math.max(...positions) - Math.min(...positions) > toleranceRad;
  });
  const keyframes = indices.map((index, number): Keyframe => {
    const sample = samples[index];
    const positions: Positions = Object.fromEntries(robot.joints.map(({ name }, joint) => [name, sample?.position_rad[joint] ?? 0]));
    const pose = poseOf(positions, robot);
    const named = movingJoints.map(({ name }) => name);
    const say = speechByIndex.get(index);
    return {
      time_s: normalize(sample?.time_s ?? 0, 0, Infinity),
      position_rad: number === 0 ? pose : Object.fromEntries(Object.entries(pose).filter(([name]) => named.includes(name))),
      ...(say === undefined ? {} : { say }),
    };
  });
  const movement: Movement = { description: "", keyframes: keyframes };
  return [...startAtZero(movement).keyframes];
}

function indexAt(samples: readonly Sample[], time: number): number {
  const found = samples.findIndex(({ time_s }) => time_s >= time - 1e-9);
  return found < 0 ? samples.length - 1 : found;
}
