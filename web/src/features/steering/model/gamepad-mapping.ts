/** Readings of a gamepad with the standard layout. They apply only while the dead-man button is held. */
import { clamp } from "../../../shared/lib/angles";

/** The used part of the browser's `Gamepad`. */
export interface Pad {
  readonly id: string;
  readonly index: number;
  readonly connected: boolean;
  readonly mapping: string;
  readonly axes: readonly number[];
  readonly buttons: readonly { readonly pressed: boolean; readonly value: number }[];
}

export interface PadReading {
  id: string;
  index: number;
  /** Whether an upper shoulder button is held (dead-man button). */
  enabled: boolean;
  stop: boolean;
  /** Right and up, -1…1. */
  left: readonly [number, number];
  right: readonly [number, number];
  /** Triggers: right minus left. */
  lift: number;
  /** D-pad: right minus left, up minus down. */
  cross: readonly [number, number];
}

/** A released stick reads at most this far from its centre. */
export const DEAD_ZONE = 0.15;

/** Rescales values outside the dead zone to the whole range, starting at 0. */
function beyondDeadZone(x: number, y: number): [number, number] {
  const length = Math.hypot(x, y);
  if (!(length > DEAD_ZONE)) return [0, 0];
  const scale = (Math.min(length, 1) - DEAD_ZONE) / (1 - DEAD_ZONE) / length;
  return [x * scale, y * scale];
}

const B = 1;
const SHOULDERS = [4, 5] as const;
const TRIGGERS = [6, 7] as const;
const CROSS = { up: 12, down: 13, left: 14, right: 15 } as const;

/** The gamepad's reading; `null`: not connected, or its layout is not standard, so its buttons are unknown. */
export function readPad(pad: Pad | null | undefined): PadReading | null {
  if (pad?.connected !== true || pad.mapping !== "standard") return null;
  const axis = (index: number): number => clamp(pad.axes[index] ?? 0, -1, 1);
  const value = (index: number): number => pad.buttons[index]?.value ?? 0;
  const pressed = (index: number): boolean => pad.buttons[index]?.pressed === true;
  const [leftX, leftY] = beyondDeadZone(axis(0), -axis(1));
  const [rightX, rightY] = beyondDeadZone(axis(2), -axis(3));
  const lift = value(TRIGGERS[1]) - value(TRIGGERS[0]);
  return {
    id: pad.id,
    index: pad.index,
    enabled: SHOULDERS.some(pressed),
    stop: pressed(B),
    left: [leftX, leftY],
    right: [rightX, rightY],
    lift: Math.abs(lift) < DEAD_ZONE ? 0 : clamp(lift, -1, 1),
    cross: [Number(pressed(CROSS.right)) - Number(pressed(CROSS.left)), Number(pressed(CROSS.up)) - Number(pressed(CROSS.down))],
  };
}
