/** Latency and the trace of the last commands, from measurements only. */
import { actionTexts, describeRequest } from "../actions";
import type { Step } from "../actions/model";
import type { DeviceSession } from "../control/model";
import { LiveLatency } from "./live-latency-card";
import { steeringTexts } from "../steering";
import { Card } from "../../shared/ui/card";
import { clock } from "../../shared/lib/clock";
import type { TraceLine, TraceStatus } from "../control/model";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";

const COLUMNS = ["accepted", "started", "observed"] as const;
const FIRST: ReadonlySet<TraceStatus> = new Set(["sent", ...COLUMNS]);

export function CommandTraceCard({ session }: { session: DeviceSession }) {
  const lines = session.commandTrace.lines.value;
  return (
    <Card title={texts.trace.latency} class="latency">
      <LiveLatency session={session} />
      <h3>{texts.trace.title}</h3>
      {lines.length === 0 ? (
        <p class="quiet">{texts.trace.none}</p>
      ) : (
        <div class="scroll command-trace" data-testid="command-trace" tabIndex={0} role="region" aria-label={texts.trace.title}>
          <table>
            <thead>
              <tr>
                <th scope="col">{texts.trace.command}</th>
                {COLUMNS.map((column) => (
                  <th key={column} scope="col">
                    {texts.trace.column[column]}
                  </th>
                ))}
                <th scope="col">{texts.trace.column.ended}</th>
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
      <p class="quiet small">{texts.trace.explained}</p>
    </Card>
  );
}

function endText({ status, request, reason }: TraceLine): string {
  const streamEnd = (steeringTexts.joints.ended as Readonly<Record<string, string>>)[reason];
  return request.kind === "stream" && streamEnd !== undefined ? streamEnd : actionTexts.status[status];
}

function Row({ line }: { line: TraceLine }) {
  const of = (status: TraceStatus): Step<TraceStatus> | undefined => line.steps.find((step) => step.status === status);
  const end = line.steps.findLast(({ status }) => !FIRST.has(status));
  const data = Object.fromEntries(COLUMNS.map((column) => [`data-${column}`, of(column)?.afterMs.toFixed(1) ?? ""]));
  return (
    <tr
      data-testid="command-trace-row"
      data-kind={line.request.kind}
      data-status={line.status}
      data-observed-by={line.observedBy ?? ""}
      data-ended={end?.afterMs.toFixed(1) ?? ""}
      {...data}
    >
      <th scope="row">
        {describeRequest(line.request)}
        <span class="quiet small">{format.age(Math.max(0, clock.value - line.clickedAt))}</span>
      </th>
      {COLUMNS.map((column) => (
        <Cell key={column} step={of(column)} note={column === "observed" && line.observedBy !== null ? texts.trace.observedBy[line.observedBy] : ""} />
      ))}
      <Cell step={end} note={end === undefined ? "" : endText(line)} failed={end !== undefined && end.status !== "done"} />
    </tr>
  );
}

/** Time and source of a step. */
function Cell({ step, note, failed = false }: { step: Step<TraceStatus> | undefined; note: string; failed?: boolean }) {
  if (step === undefined) return <td class="quiet">{format.unknown}</td>;
  const notes = [note, note === "" || note === actionTexts.status.done ? texts.trace.source[step.source] : ""];
  return (
    <td>
      {format.milliseconds(step.afterMs)}
      <span class={`small ${failed ? "ended-badly" : "quiet"}`}>{notes.filter((one) => one !== "").join(", ")}</span>
    </td>
  );
}
