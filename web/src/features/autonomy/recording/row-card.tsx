/** All values of the row at the cursor, and what the operator had seen. */
import { format } from "../../../shared/i18n/format";
import { common } from "../../../shared/i18n/common";
import { Card } from "../../../shared/ui/card";
import type { DeviceStore } from "../../devices/model";
import { MODES, type Moment, type Replay, rowOf, type Segment, SOURCES } from "../model/recording";
import { texts } from "./texts";

export function RowCard({ device, replay }: { device: DeviceStore; replay: Replay }) {
  const moment = replay.moment.value;
  const labels = new Map(device.description.value?.joints.map(({ name, label }) => [name, label]));
  const joints = replay.timeline.value.joints;
  return (
    <Card title={texts.row.title} class="session-row" data-testid="session-row">
      <Facts moment={moment} />
      <SeenButton replay={replay} />
      <table aria-label={texts.row.table}>
        <thead>
          <tr>
            {texts.row.columns.map((name) => (
              <th key={name} scope="col">
                {name}
              </th>
            ))}
          </tr>
        </thead>
        <tbody>
          {joints.map((name, joint) => (
            <tr key={name}>
              <th scope="row">{labels.get(name) ?? name}</th>
              {columnsOf(moment).map((column, index) => (
                <td key={index}>{valueAt(moment, column, joint)}</td>
              ))}
            </tr>
          ))}
        </tbody>
      </table>
      <p class="quiet small" role="status">
        {moment.kind === "sample" ? texts.row.loading : ""}
      </p>
    </Card>
  );
}

/** Measured, requested, commanded, applied. The overview has the first and the last. */
function columnsOf(moment: Moment): readonly (Float64Array | null)[] {
  if (moment.kind === "none") return [null, null, null, null];
  const { position_rad: measured, applied_rad: applied } = moment.samples;
  return moment.kind === "row" ? [measured, moment.samples.requested_rad, moment.samples.commanded_rad, applied] : [measured, null, null, applied];
}

function valueAt(moment: Moment, column: Float64Array | null, joint: number): string {
  if (moment.kind === "none" || column === null) return format.unknown;
  const value = rowOf(column, moment.samples.joints.length, moment.index)[joint] ?? NaN;
  return Number.isNaN(value) ? format.unknown : format.radiansAsDegrees(value);
}

function Facts({ moment }: { moment: Moment }) {
  const row = moment.kind === "row" ? moment : null;
  const sample = moment.kind === "none" ? null : moment;
  const source = sample === null ? undefined : SOURCES[sample.samples.source[sample.index] ?? -1];
  const mode = sample === null ? undefined : MODES[sample.samples.mode[sample.index] ?? -1];
  const setpoint = row?.samples.setpoint_sequence[row.index] ?? 0;
  const { facts } = texts.row;
  const wide = new Set<string>([facts.mode, facts.limits, facts.twist]);
  const values: [string, string][] = [
    [facts.source, source === undefined ? texts.noData[moment.kind === "none" ? moment.reason : "gap"] : texts.source[source]],
    [facts.mode, mode === undefined ? format.unknown : common.mode[mode]],
    [facts.epoch, row === null ? format.unknown : String(row.samples.epoch)],
    [facts.sequence, row === null ? format.unknown : String(row.samples.sequence[row.index])],
    [facts.limits, row === null ? format.unknown : limitsOf(row.samples, row.index)],
    [facts.setpoint, row === null ? format.unknown : setpoint === 0 ? texts.row.noSetpoint : String(setpoint)],
    [facts.age, row === null || setpoint === 0 ? format.unknown : format.milliseconds(row.samples.loop_age_ms[row.index] ?? NaN)],
  ];
  const twist = row === null ? "" : twistOf(row.samples, row.index);
  if (twist !== "") values.push([facts.twist, twist]);
  return (
    <dl class="session-facts" data-source={source ?? ""} data-kind={moment.kind}>
      {values.map(([name, value]) => (
        <div key={name} class={wide.has(name) ? "session-wide" : ""}>
          <dt>{name}</dt>
          <dd>{value}</dd>
        </div>
      ))}
    </dl>
  );
}

function limitsOf({ limited }: Segment, index: number): string {
  const limits = limited[index] ?? [];
  return limits.length === 0 ? texts.row.noLimits : limits.join(", ");
}

/** The commanded velocity of the base, or "" at rest. */
function twistOf({ twist }: Segment, index: number): string {
  const [forward = 0, left = 0, turn = 0] = rowOf(twist, 3, index);
  return forward === 0 && left === 0 && turn === 0 ? "" : texts.row.twist(forward, left, format.radiansAsDegrees(turn));
}

function SeenButton({ replay }: { replay: Replay }) {
  const seen = replay.seen.value;
  const shown = replay.showsSeen.value;
  return (
    <div class="row session-seen">
      <button
        type="button"
        data-testid="show-seen"
        aria-pressed={shown}
        disabled={seen === null}
        title={texts.seen.explained}
        onClick={() => replay.toggleSeen()}
      >
        {shown ? texts.seen.hide : texts.seen.show}
      </button>
      <span class="quiet small">{seen === null ? texts.seen.none : texts.seen.age(format.milliseconds(seen.age_ms))}</span>
    </div>
  );
}
