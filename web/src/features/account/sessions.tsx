import { useEffect, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { sentence } from "../../shared/api/http";
import type { SignInSession } from "../../shared/api/types";
import { common } from "../../shared/i18n/common";
import { Card } from "../../shared/ui/card";
import { browserName } from "./model/sign-in-notice";
import { texts } from "./texts";

/** The active sessions of the account; the user can end each one, or all others. */
export function Sessions({ api }: { api: Api }) {
  const [sessions, setSessions] = useState<SignInSession[] | null>(null);
  const [error, setError] = useState("");

  const load = async (): Promise<void> => {
    try {
      setSessions(await api.account.sessions());
    } catch (error) {
      setError(sentence(error));
    }
  };
  const end = async (ending: Promise<void>): Promise<void> => {
    setError("");
    try {
      await ending;
    } catch (error) {
      setError(sentence(error));
    }
    await load();
  };
  useEffect(() => void load(), [api]);

  return (
    <Card title={texts.account.sessions} data-testid="sessions">
      {sessions === null && error === "" && <p class="quiet">{common.loading}</p>}
      <ul class="devices">
        {sessions?.map((session) => (
          <li key={session.id} class="session">
            <span title={session.program}>
              <strong>{browserName(session.program)}</strong> <span class="quiet">{session.address}</span>
            </span>
            <span class="quiet">
              {texts.account.session(texts.account.method[session.method], session.created_at, session.last_used_at)}
            </span>
            {session.mine ? (
              <strong>{texts.account.this}</strong>
            ) : (
              <button
                type="button"
                class="plain"
                aria-label={texts.account.endOf(browserName(session.program), session.address)}
                onClick={() => void end(api.account.endSession(session.id))}
              >
                {texts.account.end}
              </button>
            )}
          </li>
        ))}
      </ul>
      {sessions !== null && sessions.length > 1 && (
        <p>
          <button type="button" onClick={() => void end(api.account.endOtherSessions())}>
            {texts.account.endOthers}
          </button>
        </p>
      )}
      <p class="field-error" aria-live="polite">
        {error}
      </p>
    </Card>
  );
}
