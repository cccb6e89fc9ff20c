/** A link that is shown this once. */
import { useEffect, useRef } from "preact/hooks";
import { texts } from "../i18n/texts";
import { Secret } from "./copy-once";

interface MadeLinkProps {
  link: string;
  /** For whom and until when. */
  note: string;
  onDone: () => void;
}

export function MadeLink({ link, note, onDone }: MadeLinkProps) {
  const box = useRef<HTMLDivElement>(null);
  useEffect(() => box.current?.querySelector("input")?.focus(), []);
  return (
    <div class="panel made" ref={box} role="group" aria-label={texts.invite.link}>
      <p>
        <strong>{texts.invite.made}</strong>
      </p>
      <Secret id="invitation-link" label={texts.invite.link} value={link} />
      <p class="quiet small">{note}</p>
      <div class="row">
        <button type="button" onClick={onDone}>
          {texts.invite.done}
        </button>
      </div>
    </div>
  );
}
