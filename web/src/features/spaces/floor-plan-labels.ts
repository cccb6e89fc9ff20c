/** Places labels on the plan without overlap. Their size depends on the text, so they are measured. */
import type { RefObject } from "preact";
import { useLayoutEffect, useRef } from "preact/hooks";
import { type Box, placeLabels, type Placed } from "./model/label-placement";

/** Size of a mark and of a pin [px]. */
const MARK_PX = 24;

/** `marks` and `pins`: centres in pixels of the box; the marks' elements have the class `occupant`, in the same order. */
export function useFloorPlanLabels(
  box: RefObject<HTMLElement | null>,
  marks: readonly (readonly [number, number])[],
  pins: readonly (readonly [number, number])[],
): void {
  const before = useRef(new Map<string, number>());
  useLayoutEffect(() => {
    if (box.current === null) return;
    const found = [...box.current.querySelectorAll<HTMLElement>(".occupant")].slice(0, marks.length);
    const names = found.map((mark) => mark.querySelector<HTMLElement>(".occupant-label"));
    const ids = found.map((mark) => mark.dataset["testid"] ?? "");
    const measured = marks.map(([x, y], index) => {
      const { offsetWidth: width = 0, offsetHeight: height = 0 } = names[index] ?? {};
      return { x, y, width, height };
    });
    const within = { width: box.current.clientWidth, height: box.current.clientHeight };
    const taken = [...pins, ...marks].map(around);
    const placed = placeLabels(measured, taken, within, ids.map((id) => before.current.get(id)));
    before.current = new Map();
    placed.forEach((place, index) => {
      const [mark, at] = [found[index], marks[index]];
      if (mark === undefined || at === undefined) return;
      if (place !== null) before.current.set(ids[index] ?? "", place.place);
      show(mark, at, place);
    });
  });
}

function around([x, y]: readonly [number, number]): Box {
  return { left: x - MARK_PX / 2, top: y - MARK_PX / 2, width: MARK_PX, height: MARK_PX };
}

function show(mark: HTMLElement, [x, y]: readonly [number, number], placed: Placed | null): void {
  const name = mark.querySelector<HTMLElement>(".occupant-label");
  const line = mark.querySelector<HTMLElement>(".occupant-leader");
  mark.classList.toggle("unnamed", placed === null);
  if (name === null || line === null) return;
  name.style.left = placed === null ? "0" : `${placed.left - x + MARK_PX / 2}px`;
  name.style.top = placed === null ? "0" : `${placed.top - y + MARK_PX / 2}px`;
  line.style.width = `${placed?.leader?.length ?? 0}px`;
  line.style.rotate = `${placed?.leader?.angleRad ?? 0}rad`;
}
