/** Converts keyframes to a movement script and back. Only an unedited script is read back: others open in the code editor. */
import { ACTION_KINDS, actionsOf, type ActionKind, type KeyframeActions, type Keyframe, type Movement } from "./keyframes";

/** The server's limit [characters]. */
export const MAX_SCRIPT_LENGTH = 65_536;
const OPENS = "KEYFRAMES = [";
const QUOTES = '"""';

export function writeScript({ description, keyframes }: Movement): string {
  return `${QUOTES}${plain(description)}

Written by the keyframe editor, which opens it again for as long as it is not changed by hand.
${QUOTES}

PARAMETERS = {
    "speed": {
        "type": "number",
        "minimum": 0.1,
        "maximum": 2,
        "default": 1,
        "description": "1: in the time of the keyframes; 0.5: in twice that time",
    },
}

# time_s in seconds, position_rad in radians.
${OPENS}
${keyframes.map((one) => `    ${literal(one)},\n`).join("")}]

robot.play(KEYFRAMES, speed=min(2, max(0.1, float(parameters.get("speed", 1)))))
`;
}

/** One line without docstring ends or escapes. */
function plain(text: string): string {
  const line = text.replaceAll('"', "'").replaceAll("\\", "/").replaceAll(/\s+/gu, " ").trim();
  return line === "" ? "A movement." : line;
}

/** JSON of these types is valid Python. */
function literal({ time_s, position_rad, ...actionValues }: Keyframe): string {
  const spaced = (value: unknown): string => {
    if (typeof value !== "object" || value === null) return JSON.stringify(value);
    return `{${Object.entries(value)
      .map(([key, one]) => `${JSON.stringify(key)}: ${spaced(one)}`)
      .join(", ")}}`;
  };
  return spaced({ time_s, position_rad, ...actionsOf(actionValues) });
}

type ParsedScript = { kind: "keyframes"; movement: Movement } | { kind: "changed" } | { kind: "other" };

/** `changed`: keyframes with manual edits. `other`: not written by the editor. */
export function readScript(source: string): ParsedScript {
  const lines = source.split("\n");
  const begin = lines.indexOf(OPENS);
  if (begin < 0 || !source.startsWith(QUOTES)) return { kind: "other" };
  const end = lines.indexOf("]", begin);
  try {
    const keyframes = lines.slice(begin + 1, end).map((line) => keyframe(JSON.parse(line.replace(/,$/, ""))));
    const movement: Movement = { description: (lines[0] ?? "").slice(QUOTES.length), keyframes };
    return keyframes.length > 0 && writeScript(movement) === source ? { kind: "keyframes", movement } : { kind: "changed" };
  } catch (error) {
    if (error instanceof SyntaxError || error instanceof TypeError) return { kind: "changed" };
    throw error;
  }
}

/** A stored movement; `null` if invalid. */
export function readMovement(value: unknown): Movement | null {
  try {
    const { description, keyframes } = object(value, "description", "keyframes");
    if (!Array.isArray(keyframes) || keyframes.length === 0) return null;
    return { description: text(description), keyframes: keyframes.map(keyframe) };
  } catch (error) {
    if (error instanceof TypeError) return null;
    throw error;
  }
}

function keyframe(value: unknown): Keyframe {
  const { time_s, position_rad, ...actionValues } = object(value, "time_s", "position_rad", ...ACTION_KINDS);
  const positions = Object.entries(object(position_rad)).map(([name, position]) => [name, number(position)] as const);
  const actions = Object.entries(actionValues).map(([kind, value]) => [kind, parseAction(kind as ActionKind, value)] as const);
  return { time_s: number(time_s), position_rad: Object.fromEntries(positions), ...(Object.fromEntries(actions) as KeyframeActions) };
}

function parseAction(kind: ActionKind, value: unknown): KeyframeActions[ActionKind] {
  switch (kind) {
    case "drive": {
      const { forward_m_s, turn_rad_s, duration_s } = object(value, "forward_m_s", "turn_rad_s", "duration_s");
      return { forward_m_s: number(forward_m_s), turn_rad_s: number(turn_rad_s), duration_s: number(duration_s) };
    }
    case "go_to": {
      const { x_m, y_m, yaw_rad } = object(value, "x_m", "y_m", "yaw_rad");
      return { x_m: number(x_m), y_m: number(y_m), ...(yaw_rad === undefined ? {} : { yaw_rad: number(yaw_rad) }) };
    }
    case "set_control": {
      const { name, value: target } = object(value, "name", "value");
      return { name: text(name), value: number(target) };
    }
    case "posture":
    case "behaviour":
    case "express":
    case "say":
      return text(value);
  }
}

/** Throws `TypeError`. Without names any field is allowed. */
function object(value: unknown, ...names: string[]): Record<string, unknown> {
  if (typeof value !== "object" || value === null || Array.isArray(value)) throw new TypeError("not an object");
  const other = Object.keys(value).find((name) => names.length > 0 && !names.includes(name));
  if (other !== undefined) throw new TypeError(`not known: ${other}`);
  return value as Record<string, unknown>;
}

function number(value: unknown): number {
  if (typeof value !== "number" || !Number.isFinite(value)) throw new TypeError("not a number");
  return value;
}

function text(value: unknown): string {
  if (typeof value !== "string") throw new TypeError("not text");
  return value;
}
