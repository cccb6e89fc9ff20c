import { useCallback, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import type { SecondFactor, SecondFactorSecret } from "../../shared/api/account";
import { sentence } from "../../shared/api/http";
import { useResource } from "../../shared/hooks/use-resource";
import { common } from "../../shared/i18n/common";
import { Card } from "../../shared/ui/card";
import { CodeForm } from "./code-form";
import { QrCode } from "./qr-code";
import { texts } from "./texts";

type Step =
  | { kind: "none" }
  | { kind: "password" }
  | { kind: "secret"; added: SecondFactorSecret }
  | { kind: "codes"; codes: string[] }
  | { kind: "renew" }
  | { kind: "disable" };

/** Adds, shows and removes the second factor of the account. */
export function SecondFactorCard({ api, onEnabled }: { api: Api; onEnabled: () => void }) {
  const load = useCallback(() => api.account.secondFactor(), [api]);
  const { value: factor, error, reload } = useResource(load);
  const [step, setStep] = useState<Step>({ kind: "none" });
  const close = (): void => {
    setStep({ kind: "none" });
    reload();
  };
  return (
    <Card title={texts.factor.title} data-testid="second-factor">
      {factor === null && error === "" && <p class="quiet">{common.loading}</p>}
      {error !== "" && <p class="field-error">{error}</p>}
      {factor !== null && step.kind === "none" && <Status factor={factor} onStep={setStep} />}
      {step.kind === "password" && (
        <AddForm api={api} onAdded={(added) => setStep({ kind: "secret", added })} onCancel={close} />
      )}
      {step.kind === "secret" && (
        <>
          <Secret added={step.added} />
          <CodeForm
            id="new-factor-code"
            label={texts.factor.confirmCode}
            submit={texts.factor.enable}
            appOnly
            onSubmit={async (code) => {
              setStep({ kind: "codes", codes: await api.account.enableSecondFactor(code) });
              onEnabled();
            }}
            onCancel={close}
          />
        </>
      )}
      {step.kind === "codes" && <Codes codes={step.codes} onDone={close} />}
      {step.kind === "renew" && (
        <CodeForm
          id="renew-code"
          label={texts.factor.code}
          submit={texts.factor.renew}
          onSubmit={async (code) => setStep({ kind: "codes", codes: await api.account.renewRecoveryCodes(code) })}
          onCancel={close}
        />
      )}
      {step.kind === "disable" && (
        <CodeForm
          id="disable-code"
          label={texts.factor.code}
          submit={texts.factor.disable}
          danger
          onSubmit={async (code) => {
            await api.account.disableSecondFactor(code);
            close();
          }}
          onCancel={close}
        />
      )}
    </Card>
  );
}

function Status({ factor, onStep }: { factor: SecondFactor; onStep: (step: Step) => void }) {
  if (!factor.enabled) {
    return (
      <>
        <p class="quiet">{texts.factor.explained}</p>
        <p>
          <button type="button" data-testid="add-factor" onClick={() => onStep({ kind: "password" })}>
            {texts.factor.add}
          </button>
        </p>
      </>
    );
  }
  return (
    <>
      <p>
        <strong>{texts.factor.on(factor.enabled_at ?? "")}</strong> {texts.factor.left(factor.recovery_codes)}
      </p>
      <div class="row">
        <button type="button" data-testid="renew-codes" onClick={() => onStep({ kind: "renew" })}>
          {texts.factor.renew}
        </button>
        <button type="button" class="plain" data-testid="disable-factor" onClick={() => onStep({ kind: "disable" })}>
          {texts.factor.disable}
        </button>
      </div>
    </>
  );
}

interface AddFormProps {
  api: Api;
  onAdded: (added: SecondFactorSecret) => void;
  onCancel: () => void;
}

/** Asks for the password: an open page alone must not be able to lock its user out. */
function AddForm({ api, onAdded, onCancel }: AddFormProps) {
  const [password, setPassword] = useState("");
  const [error, setError] = useState("");
  const add = async (): Promise<void> => {
    setError("");
    try {
      onAdded(await api.account.addSecondFactor(password));
    } catch (error) {
      setError(sentence(error));
    }
  };
  return (
    <form
      class="row-form"
      onSubmit={(event) => {
        event.preventDefault();
        void add();
      }}
    >
      <p class="quiet">{texts.factor.passwordExplained}</p>
      <label for="factor-password">{texts.factor.password}</label>
      <div class="row">
        <input
          id="factor-password"
          data-testid="factor-password"
          type="password"
          autocomplete="current-password"
          value={password}
          aria-invalid={error !== ""}
          aria-describedby="factor-password-error"
          onInput={(event) => setPassword(event.currentTarget.value)}
        />
        <button type="submit" class="primary" data-testid="factor-continue">
          {texts.factor.continue}
        </button>
        <button type="button" class="plain" onClick={onCancel}>
          {texts.factor.cancel}
        </button>
      </div>
      <p id="factor-password-error" class="field-error" aria-live="polite">
        {error}
      </p>
    </form>
  );
}

function Secret({ added }: { added: SecondFactorSecret }) {
  return (
    <>
      <p>{texts.factor.scan}</p>
      <QrCode rows={added.qr} label={texts.factor.qr} />
      <p>
        {texts.factor.byHand} <code data-testid="factor-secret" class="wrap">{added.secret.match(/.{1,4}/g)?.join(" ")}</code>
      </p>
    </>
  );
}

function Codes({ codes, onDone }: { codes: string[]; onDone: () => void }) {
  return (
    <div data-testid="recovery-codes">
      <p>
        <strong>{texts.factor.codesReady}</strong> {texts.factor.codesExplained}
      </p>
      <ul class="recovery-codes">
        {codes.map((code) => (
          <li key={code}>
            <code>{code}</code>
          </li>
        ))}
      </ul>
      <p>
        <button type="button" class="primary" data-testid="codes-saved" onClick={onDone}>
          {texts.factor.saved}
        </button>
      </p>
    </div>
  );
}
