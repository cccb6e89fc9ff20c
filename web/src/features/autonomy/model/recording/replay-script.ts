/** Converts a part of a recording to a movement script, which any robot of the type runs with all its limits. */
import { GAP_PERIODS, gapOf, rowOf } from "./samples";
import type { Segment } from "./segment";
import { MAX_SCRIPT_LENGTH, simplify } from "../../../keyframes/model";

/** What the driver applied at one moment. */
export interface AppliedSample {
  /** Since the start of the session [s]. */
  time_s: number;
  /** In the order of the joints [rad or m]. */
  position_rad: readonly number[];
}

export interface Replay {
  /** One line for people, such as the session's operator and time. */
  description: string;
  joints: readonly string[];
  /** In order of time, without missing rows. */
  samples: readonly AppliedSample[];
}

/** Why a part of a recording cannot become a movement: rows are missing, or the base moved, or it has no rows. */
export type AppliedSamples = { samples: AppliedSample[] } | { error: "gap" | "base" | "empty" };

/**
 * What the driver applied between two times [s] in all rows of `segments`, which are in order of time.
 *
 * Control periods have consecutive numbers. If time passed and no number is missing, the agent was late and the driver
 * kept what it had applied last.
 */
export function appliedBetween(segments: readonly Segment[], from_s: number, to_s: number): AppliedSamples {
  const samples: AppliedSample[] = [];
  let lastSequence: number | undefined;
  for (const segment of segments) {
    for (const [index, time_s] of segment.time_s.entries()) {
      if (time_s < from_s || time_s > to_s) continue;
      const sequence = segment.sequence[index] ?? Infinity;
      if (lastSequence !== undefined && sequence - lastSequence > GAP_PERIODS) return { error: "gap" };
      if (rowOf(segment.twist, 3, index).some((value) => value !== 0)) return { error: "base" };
      const last = samples.at(-1);
      if (last !== undefined && time_s - last.time_s > gapOf(segment)) samples.push({ ...last, time_s: time_s - segment.period_s });
      samples.push({ time_s, position_rad: Array.from(rowOf(segment.applied_rad, segment.joints.length, index)) });
      lastSequence = sequence;
    }
  }
  return samples.length === 0 ? { error: "empty" } : { samples };
}

/** `toleranceRad`: largest distance of the script's motion from the recording. `keyframes`: their number. */
export type ReplayScript = { source: string; toleranceRad: number; keyframes: number } | { error: "empty" | "too-long" };

/** A quarter of a degree, below the repeatability of teaching by hand. */
const TOLERANCE_RAD = 0.0044;
const MAX_TOLERANCE_RAD = 0.0705;
/** Longest part [s]. */
const MAX_DURATION_S = 600;
/** Samples closer than this add nothing that a robot can follow [s]. */
const INTERVAL_S = 0.05;

/** The script of a replay. A long one has fewer keyframes; one that would deviate by more than 4 degrees is rejected. */
export function replayScript({ description, joints, samples }: Replay): ReplayScript {
  const thinned = thin(samples);
  const [first, last] = [thinned[0], thinned.at(-1)];
  if (first === undefined || last === undefined) return { error: "empty" };
  if (last.time_s - first.time_s > MAX_DURATION_S) return { error: "too-long" };
  for (let toleranceRad = TOLERANCE_RAD; toleranceRad <= MAX_TOLERANCE_RAD; toleranceRad *= 2) {
    const chosen = simplify(thinned, toleranceRad, new Set()).map((index) => thinned[index]).filter((each) => each !== undefined);
    const source = write(description, joints, chosen);
    if (source.length <= MAX_SCRIPT_LENGTH) return { source, toleranceRad, keyframes: chosen.length };
  }
  return { error: "too-long" };
}

function thin(samples: readonly AppliedSample[]): AppliedSample[] {
  const kept: AppliedSample[] = [];
  samples.forEach((sample, index) => {
    const last = kept.at(-1);
    if (last === undefined || sample.time_s - last.time_s >= INTERVAL_S) kept.push(sample);
    else if (index === samples.length - 1 && kept.length > 1) kept[kept.length - 1] = sample; // the end is exact
  });
  return kept;
}

function write(description: string, joints: readonly string[], samples: readonly AppliedSample[]): string {
  const startS = samples[0]?.time_s ?? 0;
  const lines = samples.map(({ time_s, position_rad }) => {
    const positions = joints.map((_, joint) => Number((position_rad[joint] ?? 0).toFixed(4)));
    return `    [${[Number((time_s - startS).toFixed(3)), ...positions].join(", ")}],`;
  });
  return `"""${plain(description)}

Replay of a recorded session: approaches the first position on a planned path, then follows the recording.
"""

PARAMETERS = {
    "speed": {
        "type": "number",
        "minimum": 0.1,
        "maximum": 1,
        "default": 1,
        "description": "1: in the time of the recording; 0.5: in twice that time",
    },
}

JOINTS = ${JSON.stringify(joints)}
# Time [s] and the position of each joint [rad].
ROWS = [
${lines.join("\n")}
]

keyframes = [{"time_s": row[0], "position_rad": dict(zip(JOINTS, row[1:]))} for row in ROWS]
speed = min(1, max(0.1, float(parameters.get("speed", 1))))
robot.move_joints(keyframes[0]["position_rad"], speed=0.3 * speed, plan=True)
robot.play(keyframes, speed=speed)
`;
}

/** One line that cannot end the docstring. */
function plain(text: string): string {
  const line = text.replaceAll('"', "'").replaceAll("\\", "/").replaceAll(/\s+/gu, " ").trim();
  return line === "" ? "A recorded session." : line;
}
