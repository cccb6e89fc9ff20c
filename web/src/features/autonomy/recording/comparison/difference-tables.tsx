/** The figures of both sessions, and the differences of their joints. */
import { format } from "../../../../shared/i18n/format";
import type { DeviceStore } from "../../../devices/model";
import type { Comparison, SessionFigures } from "../../model/recording/comparison";
import { texts as sessionTexts } from "../texts";
import { texts } from "./texts";

type Row = keyof typeof texts.rows;

const VALUES: Record<Row, (figures: SessionFigures) => string> = {
  recorded: ({ recorded_s }) => sessionTexts.clock(recorded_s),
  operator: ({ shares }) => format.percent(shares.operator),
  movement: ({ shares }) => format.percent(shares.movement),
  hold: ({ shares }) => format.percent(shares.hold),
  stop: ({ shares }) => format.percent(shares.stop),
  stops: ({ stops }) => String(stops),
  faults: ({ faults }) => String(faults),
};

export function FiguresTable({ comparison }: { comparison: Comparison }) {
  const [first, second] = comparison.figures.value;
  return (
    <table aria-label={texts.figures} data-testid="compare-figures">
      <thead>
        <tr>
          <td />
          <th scope="col">{texts.columns.this}</th>
          <th scope="col">{texts.columns.other}</th>
        </tr>
      </thead>
      <tbody>
        {(Object.keys(texts.rows) as Row[]).map((row) => (
          <tr key={row} data-row={row}>
            <th scope="row">{texts.rows[row]}</th>
            <td>{VALUES[row](first)}</td>
            <td>{VALUES[row](second)}</td>
          </tr>
        ))}
      </tbody>
    </table>
  );
}

export function JointTable({ comparison, device }: { comparison: Comparison; device: DeviceStore }) {
  const [first, second] = comparison.figures.value;
  const labels = new Map(device.description.value?.joints.map(({ name, label }) => [name, label]));
  return (
    <table aria-label={texts.joints} data-testid="compare-joints">
      <thead>
        <tr>
          {texts.joint.map((name) => (
            <th key={name} scope="col">
              {name}
            </th>
          ))}
        </tr>
      </thead>
      <tbody>
        {comparison.differences.value.joints.map(({ joint, rms_rad, max_rad, max_at_s }, index) => (
          <tr key={joint} data-joint={joint}>
            <th scope="row">{labels.get(joint) ?? joint}</th>
            <td>{format.radiansAsDegrees(rms_rad)}</td>
            <td>
              <button type="button" class="plain" title={texts.goTo(labels.get(joint) ?? joint)} onClick={() => comparison.first.seek(max_at_s)}>
                {format.radiansAsDegrees(max_rad)}
              </button>
            </td>
            <td>{format.radiansAsDegrees(first.path_rad[index] ?? NaN)}</td>
            <td>{format.radiansAsDegrees(second.path_rad[index] ?? NaN)}</td>
          </tr>
        ))}
      </tbody>
    </table>
  );
}
