/** How long things take, and what became of the last commands: nothing here is guessed. */
import type { Station } from "../devices/model/device-session";
import type { Step } from "../actions/model/action-runner";
import { clock } from "../../shared/lib/clock";
import type { Line, LineStatus } from "./model/command-trace";
import { texts } from "../../shared/i18n/texts";
import { Latency } from "../latency/live-latency-card";
import { Card } from "../../shared/ui/parts";

const COLUMNS = ["accepted", "started", "observed"] as const;
const FIRST: ReadonlySet<LineStatus> = new Set(["sent", ...COLUMNS]);

export function Times({ station }: { station: Station }) {
  const lines = station.evidence.lines.value;
  return (
    <Card title={texts.latency.title} class="latency">
      <Latency device={station.device} control={station.control} />
      <h3>{texts.evidence.title}</h3>
      {lines.length === 0 ? (
        <p class="quiet">{texts.evidence.none}</p>
      ) : (
        <div class="scroll evidence" data-testid="evidence" tabIndex={0} role="region" aria-label={texts.evidence.title}>
          <table>
            <thead>
              <tr>
                <th scope="col">{texts.evidence.what}</th>
                {COLUMNS.map((column) => (
                  <th key={column} scope="col">
                    {texts.evidence.column[column]}
                  </th>
                ))}
                <th scope="col">{texts.evidence.column.ended}</th>
              </tr>
            </thead>
            <tbody>
              {lines.map((line) => (
                <Row key={line.key} line={line} />
              ))}
            </tbody>
          </table>
        </div>
      )}
      <p class="quiet small">{texts.evidence.explained}</p>
    </Card>
  );
}

function Row({ line }: { line: Line }) {
  const of = (status: LineStatus): Step<LineStatus> | undefined => line.steps.find((step) => step.status === status);
  const end = line.steps.find(({ status }) => !FIRST.has(status));
  const data = Object.fromEntries(COLUMNS.map((column) => [`data-${column}`, of(column)?.afterMs.toFixed(1) ?? ""]));
  return (
    <tr
      data-testid="evidence-row"
      data-kind={line.request.kind}
      data-status={line.status}
      data-seen={line.seenBy ?? ""}
      data-ended={end?.afterMs.toFixed(1) ?? ""}
      {...data}
    >
      <th scope="row">
        {texts.acts.asked(line.request)}
        <span class="quiet small">{texts.age(Math.max(0, clock.value - line.clickedAt))}</span>
      </th>
      {COLUMNS.map((column) => (
        <Cell key={column} step={of(column)} note={column === "observed" && line.seenBy !== null ? texts.evidence.seenBy[line.seenBy] : ""} />
      ))}
      <Cell step={end} note={end === undefined ? "" : texts.evidence.end(line)} bad={end !== undefined && end.status !== "done"} />
    </tr>
  );
}

/** When, and by which way it was heard. */
function Cell({ step, note, bad = false }: { step: Step<LineStatus> | undefined; note: string; bad?: boolean }) {
  if (step === undefined) return <td class="quiet">{texts.number.unknown}</td>;
  const said = [note, note === "" || note === texts.movements.status.done ? texts.evidence.heard[step.heard] : ""];
  return (
    <td>
      {texts.number.milliseconds(step.afterMs)}
      <span class={`small ${bad ? "ended-badly" : "quiet"}`}>{said.filter((one) => one !== "").join(", ")}</span>
    </td>
  );
}
