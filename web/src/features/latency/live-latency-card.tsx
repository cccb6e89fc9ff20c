import type { DeviceSession } from "../control/model";
import { Choice } from "../../shared/ui/choice";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";

export function LiveLatency({ session }: { session: DeviceSession }) {
  const { device, control } = session;
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
        <Figure name={texts.live.setpoints} value={setpointText(session)} data-testid="setpoint-transport" />
      </dl>
      {device.info.value.setpoints_over.length > 1 && <TransportChoice session={session} />}
    </>
  );
}

/** The transport of the setpoints and the state of its connection. */
function setpointText({ control }: DeviceSession): string {
  const transport = control.transport.value;
  if (transport === null) return format.unknown;
  return `${texts.live.transport[transport]}, ${texts.live.connection[control.linkStatus.value?.state ?? "closed"]}`;
}

/** The choice applies to the next lease, so that a motion never changes its transport. */
function TransportChoice({ session: { control, setpointPreference } }: { session: DeviceSession }) {
  const names = texts.live.transport;
  return (
    <div data-testid="transport-choice">
      <Choice
        label={texts.live.setpoints}
        value={setpointPreference.transport.value}
        options={[["mqtt", names.mqtt], ["xmpp", names.xmpp]]}
        onChange={(transport) => setpointPreference.choose(transport)}
      />
      {control.transport.value !== null && <p class="quiet small">{texts.live.nextControl}</p>}
    </div>
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
