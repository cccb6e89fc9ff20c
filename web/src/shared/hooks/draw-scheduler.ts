/**
 * Schedules expensive views in turn. Each frame draws at least one view and stays within a time budget, so that sliders
 * and setpoints keep priority.
 */
import { now } from "../lib/clock";

/** Drawing takes at most one part in this many of the page's time. */
const TIME_SHARE = 4;
const LONGEST_WAIT_MS = 400;
/** Nobody feels a frame that costs less [ms]. */
const FREE_MS = 6;

/** Those that want to draw, in the order in which they asked. */
const waiting = new Set<DrawSlot>();
let asked = false;

export class DrawSlot {
  readonly #draw: () => void;

  /** `draw`: called in an animation frame. */
  constructor(draw: () => void) {
    this.#draw = draw;
  }

  /** Something has changed: draw when it is this view's turn. */
  ask(): void {
    waiting.add(this);
    next();
  }

  dispose(): void {
    waiting.delete(this);
  }

  static next(): void {
    const [turn] = waiting;
    if (turn === undefined) return;
    waiting.delete(turn);
    turn.#draw();
  }
}

function next(): void {
  if (asked || waiting.size === 0) return;
  asked = true;
  requestAnimationFrame(() => {
    const startedAt = now();
    do DrawSlot.next();
    while (waiting.size > 0 && now() - startedAt < FREE_MS / 2);
    // Without a graphics card a frame can cost the page more than its share; then the next one waits.
    setTimeout(() => {
      const tookMs = now() - startedAt;
      setTimeout(
        () => {
          asked = false;
          next();
        },
        Math.min((TIME_SHARE - 1) * Math.max(0, tookMs - FREE_MS), LONGEST_WAIT_MS),
      );
    }, 0);
  });
}
