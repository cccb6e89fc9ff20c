/** A page in few words, for who sees it for the first time; folded until it is asked for. */
import { texts } from "../../shared/i18n/texts";
import "./help.css";

export function WhatDoISee({ page }: { page: keyof typeof texts.help.pages }) {
  return (
    <details class="what-do-i-see" data-testid="what-do-i-see">
      <summary>{texts.help.what}</summary>
      <ul>
        {texts.help.pages[page].map((line) => (
          <li key={line}>{line}</li>
        ))}
      </ul>
    </details>
  );
}
