/** A page in few words, for who sees it for the first time; folded until it is asked for. */
import { texts } from "./texts";
import "./help.css";

export function PageExplainer({ page }: { page: keyof typeof texts.pages }) {
  return (
    <details class="what-do-i-see" data-testid="what-do-i-see">
      <summary>{texts.title}</summary>
      <ul>
        {texts.pages[page].map((line) => (
          <li key={line}>{line}</li>
        ))}
      </ul>
    </details>
  );
}
