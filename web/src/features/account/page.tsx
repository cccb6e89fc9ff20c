import type { SignInSession } from "../../shared/api/types";
import type { Fleet } from "../devices/model";
import { Card } from "../../shared/ui/card";
import { useEffect, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { sentence } from "../../shared/api/http";
import { common } from "../../shared/i18n/common";
import { texts } from "./texts";
import { ApiKeys } from "./api-keys";
import { auditLogAddress, deviceListAddress } from "../../shared/routing/routes";

/** The user's account: password, other sessions, API keys and audit log. */
export function AccountPage({ api, fleet }: { api: Api; fleet: Fleet }) {
  const [changes, setChanges] = useState(0);
  return (
    <main class="page fleet" id="content">
      <a href={deviceListAddress}>← {common.allDevices}</a>
      <h1>{texts.account.title}</h1>
      <p>
        <a href={auditLogAddress}>{texts.audit.link}</a>
      </p>
      <ApiKeys api={api} fleet={fleet} />
      <PasswordForm api={api} onDone={() => setChanges((count) => count + 1)} />
      <Sessions key={changes} api={api} />
    </main>
  );
}

function PasswordForm({ api, onDone }: { api: Api; onDone: () => void }) {
  const [old, setOld] = useState("");
  const [wanted, setWanted] = useState("");
  const [busy, setBusy] = useState(false);
  const [wrong, setWrong] = useState("");
  const [done, setDone] = useState("");

  const change = async (): Promise<void> => {
    setWrong("");
    setDone("");
    setBusy(true);
    try {
      await api.setPassword(wanted, old);
      setOld("");
      setWanted("");
      setDone(texts.account.changed);
      onDone();
    } catch (error) {
      setWrong(sentence(error));
    } finally {
      setBusy(false);
    }
  };

  return (
    <Card title={texts.account.password}>
      <p class="quiet">{texts.account.passwordExplained}</p>
      <form
        class="row-form"
        onSubmit={(event) => {
          event.preventDefault();
          void change();
        }}
      >
        <label for="old-password">{texts.account.old}</label>
        <div class="row">
          <input
            id="old-password"
            type="password"
            autocomplete="current-password"
            value={old}
            onInput={(event) => setOld(event.currentTarget.value)}
          />
        </div>
        <label for="new-password">{texts.account.new}</label>
        <div class="row">
          <input
            id="new-password"
            type="password"
            autocomplete="new-password"
            required
            value={wanted}
            aria-invalid={wrong !== ""}
            aria-describedby="password-answer"
            onInput={(event) => setWanted(event.currentTarget.value)}
          />
          <button type="submit" disabled={busy}>
            {texts.account.change}
          </button>
        </div>
        <p id="password-answer" class={wrong === "" ? "field-note" : "field-error"} aria-live="polite">
          {wrong === "" ? done : wrong}
        </p>
      </form>
    </Card>
  );
}

function Sessions({ api }: { api: Api }) {
  const [sessions, setSessions] = useState<SignInSession[] | null>(null);
  const [wrong, setWrong] = useState("");

  const read = async (): Promise<void> => {
    try {
      setSessions(await api.sessions());
    } catch (error) {
      setWrong(sentence(error));
    }
  };
  const end = async (ending: Promise<void>): Promise<void> => {
    setWrong("");
    try {
      await ending;
    } catch (error) {
      setWrong(sentence(error));
    }
    await read();
  };
  useEffect(() => void read(), [api]);

  return (
    <Card title={texts.account.sessions}>
      {sessions === null && wrong === "" && <p class="quiet">{common.loading}</p>}
      <ul class="devices">
        {sessions?.map((session) => (
          <li key={session.id}>
            {texts.account.session(texts.account.how[session.method], new Date(session.created_at).toLocaleString("en"))}{" "}
            <span class="quiet">
              {session.address} {session.program}
            </span>{" "}
            {session.mine ? (
              <strong>{texts.account.this}</strong>
            ) : (
              <button type="button" class="plain" onClick={() => void end(api.endSession(session.id))}>
                {texts.account.end}
              </button>
            )}
          </li>
        ))}
      </ul>
      {sessions !== null && sessions.length > 1 && (
        <p>
          <button type="button" onClick={() => void end(api.endOtherSessions())}>
            {texts.account.endOthers}
          </button>
        </p>
      )}
      <p class="field-error" aria-live="polite">
        {wrong}
      </p>
    </Card>
  );
}
