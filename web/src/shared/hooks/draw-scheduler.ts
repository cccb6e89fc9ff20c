/**
 * Draws expensive views in the order of their requests. Each frame draws at least one view and stays within a time budget, so that sliders
 * and setpoints keep priority.
 */
import { now } from "../lib/clock";

/** Drawing uses at most this fraction (1/n) of the page's time, unless a view that follows the pointer needs all of it. */
const TIME_SHARE = 4;
const WHOLE_TIME = 1;
const LONGEST_WAIT_MS = 400;
/** Frames below this cost are not noticeable [ms]. */
const FREE_MS = 6;

/** Slots waiting to draw, in the order of their requests, and the fraction of time that they may use. */
const queue = new Map<DrawSlot, number>();
let scheduled = false;

export class DrawSlot {
  readonly #draw: () => void;

  /** `draw`: called in an animation frame. */
  constructor(draw: () => void) {
    this.#draw = draw;
  }

  /** Requests a redraw in one of the next frames. `unlimited`: in the next frame, because the pointer moves only this view. */
  request(unlimited = false): void {
    queue.set(this, unlimited ? WHOLE_TIME : TIME_SHARE);
    next();
  }

  dispose(): void {
    queue.delete(this);
  }

  /** Draws the next view; returns its fraction of time. */
  static next(): number {
    const [first] = queue;
    if (first === undefined) return WHOLE_TIME;
    const [slot, share] = first;
    queue.delete(slot);
    slot.#draw();
    return share;
  }
}

function next(): void {
  if (scheduled || queue.size === 0) return;
  scheduled = true;
  requestAnimationFrame(() => {
    const startedAt = now();
    let share = WHOLE_TIME;
    do share = Math.max(share, DrawSlot.next());
    while (queue.size > 0 && now() - startedAt < FREE_MS / 2);
    if (share === WHOLE_TIME) {
      scheduled = false;
      next();
      return;
    }
    // Without a GPU a frame can exceed its budget; then the next one is delayed.
    setTimeout(() => {
      const tookMs = now() - startedAt;
      setTimeout(
        () => {
          scheduled = false;
          next();
        },
        Math.min((share - 1) * Math.max(0, tookMs - FREE_MS), LONGEST_WAIT_MS),
      );
    }, 0);
  });
}
