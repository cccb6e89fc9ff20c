import type { DeviceStore } from "../devices/model";
import { Card } from "../../shared/ui/card";
import { Choice } from "../../shared/ui/choice";
import { useEffect, useRef, useState } from "preact/hooks";
import { degrees } from "../../shared/lib/angles";
import { now } from "../../shared/lib/clock";
import type { Quantity } from "./model/recent-telemetry";
import type { Joint } from "../../shared/mqtt/protocol.generated";
import { common } from "../../shared/i18n/common";
import { texts } from "./texts";
import type { Chart } from "./live-chart";
import { onColourChange, seriesColour } from "../../shared/ui/canvas-theme";

const QUANTITIES: readonly Quantity[] = ["position_rad", "velocity_rad_s", "effort_nm"];
/** Frequent enough for live plots without slowing the sliders [ms]. */
const DRAW_EVERY_MS = 66;

export function TelemetryPlot({ device }: { device: DeviceStore }) {
  const joints = device.description.value?.joints ?? [];
  const [quantity, setQuantity] = useState<Quantity>("position_rad");
  const [hidden, setHidden] = useState<ReadonlySet<string>>(new Set());
  const [failed, setFailed] = useState(false);
  const [repaint, setRepaint] = useState(0);
  const box = useRef<HTMLDivElement>(null);

  const shown = joints.map((joint, index) => ({ joint, index })).filter(({ joint }) => !hidden.has(joint.name));
  const shownNames = shown.map(({ joint }) => joint.name).join(" ");

  useEffect(() => onColourChange(() => setRepaint((count) => count + 1)), []);

  useEffect(() => {
    if (box.current === null || shownNames === "") return;
    const element = box.current;
    let active = true;
    let chart: Chart | null = null;
    let frameRequest = 0;
    let drawnAt = 0;
    const indices = shown.map(({ index }) => index);
    const draw = (at: number): void => {
      frameRequest = requestAnimationFrame(draw);
      if (at - drawnAt < DRAW_EVERY_MS) return;
      drawnAt = at;
      const [times, ...values] = device.history.columns(quantity, indices, now());
      const inUnit = quantity === "effort_nm" ? values : values.map((column) => column.map(toDegrees));
      chart?.draw([times, ...inUnit]);
    };
    import("./live-chart").then(
      ({ createChart }) => {
        if (!active) return;
        const lines = shown.map(({ joint, index }) => ({
          label: joint.label,
          colour: seriesColour(index),
          limits: limitsOf(joint, quantity),
        }));
        chart = createChart(element, lines, texts.plot.unit[quantity]);
        frameRequest = requestAnimationFrame(draw);
      },
      () => setFailed(true),
    );
    return () => {
      active = false;
      cancelAnimationFrame(frameRequest);
      chart?.dispose();
    };
    // `wanted` contains the joint names: a new array with the same joints must not rebuild the chart.
  }, [device, quantity, shownNames, repaint]);

  const toggle = (name: string): void => {
    const next = new Set(hidden);
    if (!next.delete(name)) next.add(name);
    setHidden(next);
  };

  return (
    <Card
      title={texts.plot.title}
      class="plot"
      aside={
        <Choice
          label={texts.plot.choose}
          value={quantity}
          onChange={setQuantity}
          options={QUANTITIES.map((one) => [one, texts.plot.quantity[one]] as const)}
        />
      }
    >
      {failed && <p class="notice">{common.chartFailed}</p>}
      <div
        ref={box}
        class={`chart ${device.live.value ? "" : "old"}`}
        data-testid="plot"
        role="img"
        aria-label={texts.plot.label(texts.plot.quantity[quantity])}
      />
      <fieldset class="legend">
        <legend class="visually-hidden">{texts.plot.joints}</legend>
        {joints.map((joint, index) => (
          <label key={joint.name} class={`series-${(index % 8) + 1}`}>
            <input type="checkbox" checked={!hidden.has(joint.name)} onChange={() => toggle(joint.name)} />
            {joint.label} <span class="quiet">{texts.plot.limits(limitsOf(joint, quantity), texts.plot.unit[quantity])}</span>
          </label>
        ))}
      </fieldset>
    </Card>
  );
}

function toDegrees(value: number | null): number | null {
  return value === null ? null : degrees(value);
}

/** A joint's limits in the plot's unit. */
function limitsOf(joint: Joint, quantity: Quantity): [number, number] {
  switch (quantity) {
    case "position_rad":
      return [degrees(joint.lower_rad), degrees(joint.upper_rad)];
    case "velocity_rad_s":
      return [-degrees(joint.max_velocity_rad_s), degrees(joint.max_velocity_rad_s)];
    case "effort_nm":
      return [-joint.max_effort_nm, joint.max_effort_nm];
  }
}
