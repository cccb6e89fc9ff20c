/** A short explanation of a page, collapsed by default. */
import { texts } from "./texts";
import "./help.css";

export function PageExplainer({ page }: { page: keyof typeof texts.pages }) {
  return (
    <details class="page-explainer" data-testid="page-explainer">
      <summary>{texts.title}</summary>
      <ul>
        {texts.pages[page].map((line) => (
          <li key={line}>{line}</li>
        ))}
      </ul>
    </details>
  );
}
