/** All sessions and events of the shown time, newest first. */
import { format } from "../../../shared/i18n/format";
import { deviceAddress } from "../../../shared/routing/routes";
import { endOf, whoOf } from "./entry-texts";
import type { NamedRow } from "./page";
import { texts } from "./texts";

interface Entry {
  key: string;
  atMs: number;
  device: string;
  label: string;
  what: string;
  until: string;
}

export function TimelineTable({ rows }: { rows: readonly NamedRow[] }) {
  const entries = rows.flatMap(entriesOf).sort((one, other) => other.atMs - one.atMs);
  const failed = rows.filter(({ error }) => error !== "");
  return (
    <>
      {failed.map(({ device, label, error }) => (
        <p key={device} class="notice bad">
          {label}: {texts.rowFailed(error)}
        </p>
      ))}
      {entries.length === 0 ? (
        <p class="quiet">{texts.empty}</p>
      ) : (
        <div class="scroll" tabIndex={0} role="region" aria-label={texts.table}>
          <table data-testid="timeline-table">
            <thead>
              <tr>
                {texts.columns.map((name) => (
                  <th key={name} scope="col">
                    {name}
                  </th>
                ))}
              </tr>
            </thead>
            <tbody>
              {entries.map(({ key, atMs, device, label, what, until }) => (
                <tr key={key}>
                  <td>{format.recentTime(atMs)}</td>
                  <th scope="row">
                    <a href={deviceAddress(device)}>{label}</a>
                  </th>
                  <td>{what}</td>
                  <td>{until}</td>
                </tr>
              ))}
            </tbody>
          </table>
        </div>
      )}
    </>
  );
}

function entriesOf({ device, label, intervals, marks }: NamedRow): Entry[] {
  return [
    ...intervals.map((each): Entry => ({ key: `${device} ${each.epoch}`, atMs: each.fromMs, device, label, what: whoOf(each), until: endOf(each) })),
    ...marks.map(({ atMs, kind, message }, index): Entry => ({ key: `${device} event ${index}`, atMs, device, label, what: `${texts.mark[kind]}: ${message}`, until: "" })),
  ];
}
