import type { Account } from "../../shared/api/types";
import { accountLabel } from "../../shared/lib/account-label";
import type { Fleet } from "../devices/model";
import { Card } from "../../shared/ui/card";
import { useEffect, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { sentence } from "../../shared/api/http";
import { common } from "../../shared/i18n/common";
import { texts } from "./texts";
import { ApiKeys } from "./api-keys";
import { SecondFactorCard } from "./second-factor";
import { Sessions } from "./sessions";
import { auditLogAddress, deviceListAddress } from "../../shared/routing/routes";

/** The user's account: password, storage, other sessions, API keys and audit log. */
export function AccountPage({ api, fleet, account }: { api: Api; fleet: Fleet; account: Account }) {
  const [changes, setChanges] = useState(0);
  return (
    <main class="page fleet" id="content">
      <a href={deviceListAddress}>← {common.allDevices}</a>
      <h1>{texts.account.title}</h1>
      <p>{texts.account.identity(accountLabel(account.name, account.id))}</p>
      <p>
        <a href={auditLogAddress}>{texts.audit.link}</a>
      </p>
      <ApiKeys api={api} fleet={fleet} />
      <PasswordForm api={api} onDone={() => setChanges((count) => count + 1)} />
      <Storage api={api} />
      <SecondFactorCard api={api} onEnabled={() => setChanges((count) => count + 1)} />
      <Sessions key={changes} api={api} />
    </main>
  );
}

function Storage({ api }: { api: Api }) {
  const [usage, setUsage] = useState(common.loading);
  useEffect(() => {
    api.storage().then(
      (storage) => setUsage(texts.account.used(storage.used_bytes, storage.limit_bytes)),
      (error: unknown) => setUsage(sentence(error)),
    );
  }, [api]);
  return (
    <Card title={texts.account.storage}>
      <p aria-live="polite">{usage}</p>
    </Card>
  );
}

function PasswordForm({ api, onDone }: { api: Api; onDone: () => void }) {
  const [oldPassword, setOldPassword] = useState("");
  const [newPassword, setNewPassword] = useState("");
  const [busy, setBusy] = useState(false);
  const [error, setError] = useState("");
  const [message, setMessage] = useState("");

  const change = async (): Promise<void> => {
    setError("");
    setMessage("");
    setBusy(true);
    try {
      await api.account.setPassword(newPassword, oldPassword);
      setOldPassword("");
      setNewPassword("");
      setMessage(texts.account.changed);
      onDone();
    } catch (error) {
      setError(sentence(error));
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
            value={oldPassword}
            onInput={(event) => setOldPassword(event.currentTarget.value)}
          />
        </div>
        <label for="new-password">{texts.account.new}</label>
        <div class="row">
          <input
            id="new-password"
            type="password"
            autocomplete="new-password"
            required
            value={newPassword}
            aria-invalid={error !== ""}
            aria-describedby="password-answer"
            onInput={(event) => setNewPassword(event.currentTarget.value)}
          />
          <button type="submit" disabled={busy}>
            {texts.account.change}
          </button>
        </div>
        <p id="password-answer" class={error === "" ? "field-note" : "field-error"} aria-live="polite">
          {error === "" ? message : error}
        </p>
      </form>
    </Card>
  );
}
