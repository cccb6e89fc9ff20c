/** The time axis of the other session below that of this one, at the same scale. */
import { useRef } from "preact/hooks";
import type { Comparison } from "../../model/recording/comparison";
import { scrubbing, timeAtX, useCursorPosition, usePainting, useWheelZoom } from "../timeline-bar";
import { texts } from "./texts";

export function ComparedBar({ comparison }: { comparison: Comparison }) {
  const box = useRef<HTMLDivElement>(null);
  const canvas = useRef<HTMLCanvasElement>(null);
  const { first, second, window } = comparison;
  useCursorPosition(box, first);
  useWheelZoom(box, first, () => true);
  usePainting(canvas, second, window);
  return (
    <>
      <p class="session-bar-name quiet small">{texts.otherAxis}</p>
      <div class="session-axis" ref={box}>
        <div class="session-bar" data-testid="compared-bar" {...scrubbing(first, (clientX) => timeAtX(box.current, first, clientX))}>
          <canvas ref={canvas} role="img" aria-label={texts.otherAxis} />
          <div class="session-line-cursor" />
        </div>
      </div>
    </>
  );
}
