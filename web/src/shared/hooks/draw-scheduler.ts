/**
 * Schedules expensive views in turn. Each frame draws at least one view and stays within a time budget, so that sliders
 * and setpoints keep priority.
 */
import { now } from "../lib/clock";

/** Drawing uses at most this fraction (1/n) of the page's time. */
const TIME_SHARE = 4;
const LONGEST_WAIT_MS = 400;
/** Frames below this cost are not noticeable [ms]. */
const FREE_MS = 6;

/** Slots waiting to draw, in the order of their requests. */
const waiting = new Set<DrawSlot>();
let asked = false;

export class DrawSlot {
  readonly #draw: () => void;

  /** `draw`: called in an animation frame. */
  constructor(draw: () => void) {
    this.#draw = draw;
  }

  /** Requests a redraw in this view's next turn. */
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
    // Without a GPU a frame can exceed its budget; then the next one is delayed.
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
