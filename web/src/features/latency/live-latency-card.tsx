import type { Control } from "../control/model";
import type { DeviceStore } from "../devices/model";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";

interface LatencyProps {
  device: DeviceStore;
  control: Control;
}

export function LiveLatency({ device, control }: LatencyProps) {
  const figures = control.roundTrip.figures.value;
  const telemetry = device.telemetry.value;
  const age = device.telemetryAgeMs.value;
  const watchdog = device.description.value?.watchdog_ms;
  const ms = format.milliseconds;
  const loopAge = telemetry !== null && telemetry.message.setpoint_sequence > 0 ? telemetry.message.loop_age_ms : null;
  return (
    <>
      <div
        class="figure"
        data-testid="round-trip"
        data-value={figures?.medianMs.toFixed(2) ?? ""}
        data-p95={figures?.p95Ms.toFixed(2) ?? ""}
        data-latest={figures?.latestMs.toFixed(2) ?? ""}
        data-samples={figures?.samples ?? 0}
      >
        <h3>{texts.live.roundTrip}</h3>
        {figures === null ? (
          <p class="quiet">{texts.live.none}</p>
        ) : (
          <dl class="figures">
            <Figure name={texts.live.median} value={ms(figures.medianMs)} />
            <Figure name={texts.live.p95} value={ms(figures.p95Ms)} />
            <Figure name={texts.live.latest} value={ms(figures.latestMs)} />
          </dl>
        )}
        <p class="quiet small">{texts.live.explained}</p>
      </div>
      <dl class={`figures ${device.live.value ? "" : "old"}`}>
        <Figure
          name={texts.live.telemetryAge}
          value={age === null ? format.unknown : ms(age)}
          data-testid="telemetry-age"
        />
        <Figure
          name={texts.live.loopAge}
          value={loopAge === null ? format.unknown : ms(loopAge)}
          title={texts.live.loopExplained}
        />
        <Figure
          name={texts.live.watchdog}
          value={watchdog === undefined || watchdog === 0 ? format.unknown : ms(watchdog)}
        />
      </dl>
    </>
  );
}

interface FigureProps {
  name: string;
  value: string;
  title?: string;
  "data-testid"?: string;
}

function Figure({ name, value, ...rest }: FigureProps) {
  return (
    <div {...rest}>
      <dt>{name}</dt>
      <dd>{value}</dd>
    </div>
  );
}
