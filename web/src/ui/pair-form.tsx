import { useState } from "preact/hooks";
import { sentence } from "../core/api";
import type { Fleet } from "../core/fleet";
import { texts } from "../texts";
import { Card } from "./parts";

/** The agent's alphabet has no vowels and nothing that looks like a digit. */
const CODE = /^[BCDFGHJKLMNPQRSTVWXZ]{8}$/;

function tidy(typed: string): string {
  return typed.toUpperCase().replace(/[^A-Z0-9]/g, "");
}

export function PairForm({ fleet }: { fleet: Fleet }) {
  const [typed, setTyped] = useState("");
  const [busy, setBusy] = useState(false);
  const [wrong, setWrong] = useState("");
  const [done, setDone] = useState("");

  const pair = async (): Promise<void> => {
    setWrong("");
    setDone("");
    const code = tidy(typed);
    if (!CODE.test(code)) {
      setWrong(texts.pair.malformed);
      return;
    }
    setBusy(true);
    try {
      const devices = await fleet.claim(`${code.slice(0, 4)}-${code.slice(4)}`);
      setDone(texts.pair.done(devices.map((device) => device.label).join(", ")));
      setTyped("");
    } catch (error) {
      setWrong(sentence(error)); // What was typed stays.
    } finally {
      setBusy(false);
    }
  };

  return (
    <Card title={texts.pair.title} class="pair">
      <p class="quiet">{texts.pair.explain}</p>
      <form
        class="row-form"
        onSubmit={(event) => {
          event.preventDefault();
          void pair();
        }}
      >
        <label for="claim-code">{texts.pair.code}</label>
        <div class="row">
          <input
            id="claim-code"
            data-testid="claim-code"
            type="text"
            autocomplete="off"
            autocapitalize="characters"
            spellcheck={false}
            placeholder={texts.pair.example}
            maxLength={20}
            value={typed}
            aria-invalid={wrong !== ""}
            aria-describedby="claim-answer"
            onInput={(event) => setTyped(event.currentTarget.value)}
          />
          <button type="submit" data-testid="claim" disabled={busy}>
            {busy ? texts.pair.busy : texts.pair.submit}
          </button>
        </div>
        <p id="claim-answer" class={wrong === "" ? "field-note" : "field-error"} aria-live="polite">
          {wrong === "" ? done : wrong}
        </p>
      </form>
    </Card>
  );
}
