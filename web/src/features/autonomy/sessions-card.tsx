/** Who has had control of the device, and who moved it in each session. */
import { useEffect, useMemo } from "preact/hooks";
import type { StoredSession } from "../../shared/api/autonomy";
import type { Api } from "../../shared/api/client";
import { common } from "../../shared/i18n/common";
import { format } from "../../shared/i18n/format";
import { serverNow } from "../../shared/lib/clock";
import { sessionAddress } from "../../shared/routing/routes";
import { Card } from "../../shared/ui/card";
import { durationText, secondsOf, SessionHistory } from "./model";
import { ShareBar } from "./share-bar";
import { texts } from "./texts";

export function SessionsCard({ api, device, everyMs }: { api: Api; device: string; everyMs: number }) {
  const history = useMemo(() => new SessionHistory(api, device), [api, device]);
  useEffect(() => {
    void history.refresh();
    const timer = setInterval(() => {
      if (document.visibilityState === "visible") void history.refresh();
    }, everyMs);
    return () => clearInterval(timer);
  }, [history, everyMs]);
  const sessions = history.sessions.value;
  const error = history.error.value;
  const more = history.more.value;
  return (
    <Card title={texts.sessions} data-testid="sessions">
      <p class="quiet small">{texts.sessionsExplained}</p>
      {sessions !== null && sessions.length > 0 && (
        <ol class="session-list">
          {sessions.map((session) => (
            <Session key={session.epoch} device={device} session={session} />
          ))}
        </ol>
      )}
      {error !== "" && (
        <p class="notice bad" role="alert">
          {common.loadFailed(error)}
        </p>
      )}
      {(sessions !== null || error === "") && (
        <p class="quiet small" role="status">
          {sessions === null ? common.loading : sessions.length === 0 ? texts.noSessions : texts.shown(sessions.length, more)}
        </p>
      )}
      {more && (
        <p>
          <button type="button" disabled={history.busy.value} data-testid="older-sessions" onClick={() => void history.loadOlder()}>
            {texts.older}
          </button>
        </p>
      )}
    </Card>
  );
}

function Session({ device, session }: { device: string; session: StoredSession }) {
  const { epoch, holder, action, task, outcome, started_at: start, share, recorded } = session;
  const movingS = share.operator_s + share.machine_s;
  return (
    <li data-testid="session" data-epoch={epoch} data-task={task ?? ""} data-operator-s={share.operator_s} data-machine-s={share.machine_s}>
      <span class="session-when">
        <strong>{holder ?? texts.unknownHolder}</strong>
        <span class="quiet small">
          {start === null ? texts.unknownStart : <time dateTime={start}>{format.dateTime(start)}</time>}, {lengthOf(session)}
        </span>
      </span>
      <span class="session-task">
        {action === null ? texts.manual : task === null ? texts.deletedAction : texts.task(task)}
        {outcome !== null && <span class={`chip ${outcome === "failed" ? "bad" : ""}`}>{texts.outcome[outcome] ?? texts.running}</span>}
        {recorded && (
          <a href={sessionAddress(device, epoch)} data-testid="open-recording">
            {texts.openRecording}
          </a>
        )}
        {session.intervened && (
          <span class="chip reach-stale" title={texts.interventionExplained} data-testid="intervention">
            {texts.intervention}
          </span>
        )}
      </span>
      <span class="session-share">
        <ShareBar operatorS={share.operator_s} machineS={share.machine_s} small />
        <span class="quiet small">{movingS === 0 ? texts.notMoved : durationText(movingS)}</span>
      </span>
    </li>
  );
}

function lengthOf(session: StoredSession): string {
  const seconds = secondsOf(session, serverNow());
  if (session.ended_at === null) return seconds === null ? texts.lastsUnknown : texts.lasts(durationText(seconds));
  return seconds === null ? format.unknown : durationText(seconds);
}
