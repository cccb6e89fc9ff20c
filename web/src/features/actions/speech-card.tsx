import { useEffect, useRef, useState } from "preact/hooks";
import type { ActionRunner } from "./model/action-runner";
import { texts } from "./texts";
import { startAction, type ActionCardProps } from "./action-cards";

const MAX_LENGTH = 2000;
/** A BCP 47 tag: `en`, `sk`, `en-GB`; or empty. */
const LANGUAGE = /^([A-Za-z]{1,8}(-[A-Za-z0-9]{1,8})*)?$/;

/** Enter sends the text; Shift+Enter starts a new line. The text is cleared only after success. */
export function SpeechCard({ session, disabledReason }: ActionCardProps) {
  const [text, setText] = useState("");
  const [language, setLanguage] = useState("");
  const sentText = useRef("");
  useSpeechStart(session.actions, sentText, (spoken) => setText((current) => (current === spoken ? "" : current)));
  const validLanguage = LANGUAGE.test(language.trim());
  const ready = disabledReason === "" && text.trim() !== "" && validLanguage;
  const send = (): void => {
    if (!ready) return;
    sentText.current = text;
    startAction(session, { kind: "say", text: text.trim(), language: language.trim() });
  };
  return (
    <form
      class="act-speech"
      onSubmit={(event) => {
        event.preventDefault();
        send();
      }}
    >
      <label>
        {texts.textToSpeak}
        <textarea
          rows={2}
          maxLength={MAX_LENGTH}
          value={text}
          data-testid="say-text"
          onInput={(event) => setText(event.currentTarget.value)}
          onKeyDown={(event) => {
            if (event.key !== "Enter" || event.shiftKey || event.isComposing) return;
            event.preventDefault();
            send();
          }}
        />
      </label>
      <div class="row">
        <label class="act-language">
          {texts.language}
          <input
            type="text"
            list="say-languages"
            value={language}
            placeholder={texts.defaultLanguage}
            aria-invalid={!validLanguage}
            autocapitalize="off"
            data-testid="say-language"
            onInput={(event) => setLanguage(event.currentTarget.value)}
          />
        </label>
        <datalist id="say-languages">
          {Object.entries(texts.languages).map(([code, name]) => (
            <option key={code} value={code}>
              {name}
            </option>
          ))}
        </datalist>
        <button type="submit" class="primary" data-testid="say" disabled={!ready} title={disabledReason === "" ? undefined : disabledReason}>
          {texts.speak}
        </button>
      </div>
    </form>
  );
}

/** Calls back once when the speech starts. */
function useSpeechStart(actions: ActionRunner, sentText: { current: string }, onStart: (text: string) => void): void {
  const run = actions.run.value;
  const startedKey = run?.request.kind === "say" && (run.status === "started" || run.status === "done") ? run.key : "";
  useEffect(() => {
    if (startedKey !== "") onStart(sentText.current);
  }, [startedKey]);
}
