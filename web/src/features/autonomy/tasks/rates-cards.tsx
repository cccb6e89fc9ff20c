/** Success rates of a task: in all, by robot, by version and by day; and published batches. */
import type { Batch, Rate, TaskReport } from "../../../shared/api/tasks";
import { format } from "../../../shared/i18n/format";
import { Card } from "../../../shared/ui/card";
import { rateText } from "../model";
import { RateBar } from "./rate-bar";
import { texts } from "./texts";

interface Row {
  id: string;
  label: string;
  rate: Rate;
  note?: string;
}

export function RatesCard({ task, labels }: { task: TaskReport; labels: ReadonlyMap<string, string> }) {
  const groups: [string, Row[]][] = [
    [texts.byRobot, task.devices.map(({ device, rate }) => ({ id: device, label: labels.get(device) ?? device, rate }))],
    [texts.byVersion, task.versions.map(({ type_version: version, rate }) => ({ id: String(version), label: texts.version(version), rate }))],
    [texts.byDay, task.days.map(({ at, rate }) => ({ id: at, label: format.utcDay(Date.parse(at)), rate }))],
  ];
  return (
    <Card title={texts.rate} data-testid="rates">
      <p class="quiet small">{texts.rateExplained}</p>
      {!task.complete && <p class="notice warn">{texts.incomplete}</p>}
      <p data-testid="rate-of-all">
        <strong>{rateText(task.rate)}</strong>
        {task.rate.unknown > 0 && <span class="quiet"> · {texts.unknown(task.rate.unknown)}</span>}
      </p>
      <RateBar rate={task.rate} />
      {task.devices.length > 0 && (
        <div class="task-columns">
          {groups.map(([title, rows]) => (
            <section key={title}>
              <h3>{title}</h3>
              <RateTable title={title} rows={rows} />
            </section>
          ))}
        </div>
      )}
    </Card>
  );
}

export function BatchesCard({ batches }: { batches: readonly Batch[] }) {
  const rows = batches.map((batch) => ({
    id: `${batch.published_at} ${batch.first_seed}`,
    label: texts.batch(batch.first_seed, batch.rate.trials),
    rate: batch.rate,
    note: texts.publishedBy(batch.published_by, format.dateTime(batch.published_at)),
  }));
  return (
    <Card title={texts.batches} data-testid="batches">
      <p class="quiet small">{texts.batchesExplained}</p>
      <RateTable title={texts.batches} rows={rows} />
    </Card>
  );
}

function RateTable({ title, rows }: { title: string; rows: readonly Row[] }) {
  return (
    <div class="scroll" tabIndex={0} role="region" aria-label={title}>
      <table class="rate-table">
        <thead>
          <tr>
            {texts.rateColumns.map((name) => (
              <th key={name} scope="col">
                {name}
              </th>
            ))}
          </tr>
        </thead>
        <tbody>
          {rows.map(({ id, label, rate, note }) => (
            <tr key={id}>
              <th scope="row">
                {label} {note !== undefined && <span class="quiet small">{note}</span>}
              </th>
              <td>
                <RateBar rate={rate} />
              </td>
              <td>{texts.successes(rate.successes, rate.trials)}</td>
            </tr>
          ))}
        </tbody>
      </table>
    </div>
  );
}
