/** The code editor, in a shadow tree with adopted style sheets: the page's policy forbids inline styles. */
import { autocompletion, closeBrackets, closeBracketsKeymap, completionKeymap } from "@codemirror/autocomplete";
import { defaultKeymap, history, historyKeymap } from "@codemirror/commands";
import { python, pythonLanguage } from "@codemirror/lang-python";
import { bracketMatching, HighlightStyle, indentOnInput, indentUnit, syntaxHighlighting } from "@codemirror/language";
import { linter, lintGutter, lintKeymap, type Diagnostic } from "@codemirror/lint";
import { unifiedMergeView } from "@codemirror/merge";
import { highlightSelectionMatches, searchKeymap } from "@codemirror/search";
import { EditorState, Prec, StateEffect, type Extension } from "@codemirror/state";
import { drawSelection, EditorView, highlightActiveLine, highlightActiveLineGutter, keymap, lineNumbers, tooltips } from "@codemirror/view";
import { tags } from "@lezer/highlight";
import type { Scripting } from "../../shared/api/movement-library";
import type { TextRange } from "./model/text-offsets";
import { complete } from "./completion";

const CHECK_AFTER_MS = 500;
const checkAgain = StateEffect.define();

const theme = EditorView.theme({
  "&": { color: "var(--text)", backgroundColor: "var(--surface)", fontSize: "0.9rem", height: "100%" },
  "&.cm-focused": { outline: "3px solid var(--focus)", outlineOffset: "1px" },
  ".cm-scroller": { fontFamily: "ui-monospace, SFMono-Regular, Menlo, Consolas, monospace", lineHeight: "1.5" },
  ".cm-content": { caretColor: "var(--text)" },
  ".cm-cursor, .cm-dropCursor": { borderLeftColor: "var(--text)" },
  "&.cm-focused > .cm-scroller > .cm-selectionLayer .cm-selectionBackground, .cm-selectionBackground": {
    background: "color-mix(in srgb, var(--accent) 28%, transparent)",
  },
  ".cm-gutters": { backgroundColor: "var(--sunken)", color: "var(--quiet)", borderRight: "1px solid var(--line)" },
  ".cm-activeLine": { backgroundColor: "color-mix(in srgb, var(--accent) 6%, transparent)" },
  ".cm-activeLineGutter": { backgroundColor: "var(--line)", color: "var(--text)" },
  ".cm-selectionMatch": { backgroundColor: "color-mix(in srgb, var(--accent) 14%, transparent)" },
  ".cm-matchingBracket, &.cm-focused .cm-matchingBracket": {
    backgroundColor: "color-mix(in srgb, var(--accent) 24%, transparent)",
  },
  ".cm-tooltip": {
    color: "var(--text)",
    backgroundColor: "var(--surface)",
    border: "1px solid var(--line-strong)",
    borderRadius: "6px",
    boxShadow: "var(--shadow)",
  },
  ".cm-tooltip.cm-tooltip-autocomplete > ul > li[aria-selected]": {
    backgroundColor: "var(--accent)",
    color: "var(--accent-text)",
  },
  ".cm-completionInfo": { maxWidth: "min(26rem, 80vw)", padding: "0.5rem 0.7rem", whiteSpace: "pre-wrap" },
  ".cm-completionDetail": { fontStyle: "normal", opacity: "1" },
  // Replaces the library's images with inline styles, which the page's policy forbids.
  ".cm-lintRange": { backgroundImage: "none !important" },
  ".cm-lintRange-error": { textDecoration: "underline wavy var(--bad)" },
  ".cm-lintRange-warning": { textDecoration: "underline wavy var(--warn)" },
  ".cm-lint-marker": { content: "none !important", borderRadius: "50%" },
  ".cm-lint-marker-error": { backgroundColor: "var(--bad)" },
  ".cm-lint-marker-warning": { backgroundColor: "var(--warn)", borderRadius: "2px" },
  ".cm-diagnostic-error": { borderLeftColor: "var(--bad)" },
  ".cm-diagnostic-warning": { borderLeftColor: "var(--warn)" },
  ".cm-panels": { backgroundColor: "var(--sunken)", color: "var(--text)" },
  ".cm-textfield": { backgroundColor: "var(--surface)", borderColor: "var(--line-strong)" },
  ".cm-button": {
    backgroundImage: "none",
    backgroundColor: "var(--surface)",
    color: "var(--text)",
    borderColor: "var(--line-strong)",
  },
  ".cm-changedLine, .cm-insertedLine": { backgroundColor: "var(--good-ground)" },
  ".cm-changedText, &.cm-merge-b .cm-changedText": { background: "none", textDecoration: "underline 2px" },
  ".cm-deletedChunk": { backgroundColor: "var(--bad-ground)" },
  ".cm-deletedChunk .cm-deletedText": { background: "none" },
  ".cm-collapsedLines": { color: "var(--text)", background: "var(--sunken)" },
});

const colours = HighlightStyle.define([
  { tag: [tags.keyword, tags.operatorKeyword, tags.controlKeyword], color: "var(--accent)", fontWeight: "600" },
  { tag: [tags.string, tags.special(tags.string)], color: "var(--good)" },
  { tag: [tags.number, tags.bool, tags.null], color: "var(--warn)" },
  { tag: tags.comment, color: "var(--quiet)", fontStyle: "italic" },
  { tag: [tags.definition(tags.variableName), tags.function(tags.definition(tags.variableName))], fontWeight: "600" },
  { tag: tags.invalid, color: "var(--bad)" },
]);

/** Shared by the editor and the comparison. */
const shared: Extension = [
  lineNumbers(),
  python(),
  theme,
  syntaxHighlighting(colours),
  EditorView.lineWrapping,
];

interface CodeEditorOptions {
  text: string;
  label: string;
  description: string;
  /** The available functions and names; `null` until loaded. */
  scripting: () => Scripting | null;
  parameters: () => readonly string[];
  check: (text: string) => Promise<readonly TextRange[]>;
  onChange: (text: string) => void;
  onSave: () => void;
  /** Called for Escape if no other handler used it. */
  onLeave: () => void;
}

export class CodeEditor {
  readonly #view: EditorView;

  constructor(host: HTMLElement, options: CodeEditorOptions) {
    const root = shadow(host);
    const save = (): boolean => {
      options.onSave();
      return true;
    };
    this.#view = new EditorView({
      root,
      parent: root,
      state: EditorState.create({
        doc: options.text,
        extensions: [
          shared,
          lintGutter(),
          highlightActiveLine(),
          highlightActiveLineGutter(),
          highlightSelectionMatches(),
          history(),
          drawSelection(),
          indentUnit.of("    "),
          indentOnInput(),
          bracketMatching(),
          closeBrackets(),
          tooltips({ position: "absolute" }),
          autocompletion({ icons: false }),
          pythonLanguage.data.of({
            autocomplete: (context: Parameters<typeof complete>[1]) => {
              const scripting = options.scripting();
              return scripting === null ? null : complete(scripting, context, options.parameters());
            },
          }),
          linter((view) => diagnostics(options.check(view.state.doc.toString())), {
            delay: CHECK_AFTER_MS,
            needsRefresh: ({ transactions }) => transactions.some(({ effects }) => effects.some((one) => one.is(checkAgain))),
          }),
          EditorView.contentAttributes.of({ "aria-label": options.label, "aria-description": options.description }),
          EditorView.updateListener.of((update) => {
            if (update.docChanged) options.onChange(update.state.doc.toString());
          }),
          Prec.high(keymap.of([{ key: "Mod-s", run: save, preventDefault: true }])),
          // Not Tab: it moves the focus, as on the rest of the page.
          keymap.of([
            ...closeBracketsKeymap,
            ...completionKeymap,
            ...lintKeymap,
            ...searchKeymap,
            ...historyKeymap,
            ...defaultKeymap.filter(({ key }) => key !== "Escape"),
            { key: "Escape", run: () => (options.onLeave(), true) },
          ]),
        ],
      }),
    });
  }

  get text(): string {
    return this.#view.state.doc.toString();
  }

  /** Replaces the text; can be undone. */
  replace(text: string): void {
    this.#view.dispatch({ changes: { from: 0, to: this.#view.state.doc.length, insert: text } });
  }

  checkAgain(): void {
    this.#view.dispatch({ effects: checkAgain.of(null) });
  }

  goTo(offset: number): void {
    const anchor = Math.min(offset, this.#view.state.doc.length);
    this.#view.dispatch({ selection: { anchor }, effects: EditorView.scrollIntoView(anchor, { y: "center" }) });
    this.#view.focus();
  }

  focus(): void {
    this.#view.focus();
  }

  dispose(): void {
    this.#view.destroy();
  }
}

/** A read-only text with the changes since another one. */
export class Comparison {
  readonly #view: EditorView;

  constructor(host: HTMLElement, before: string, after: string, label: string) {
    const root = shadow(host);
    this.#view = new EditorView({
      root,
      parent: root,
      state: EditorState.create({
        doc: after,
        extensions: [
          shared,
          EditorState.readOnly.of(true),
          EditorView.contentAttributes.of({ "aria-label": label, tabindex: "0" }),
          EditorView.editable.of(false),
          unifiedMergeView({
            original: before,
            mergeControls: false,
            highlightChanges: true,
            gutter: true,
            collapseUnchanged: { margin: 3, minSize: 6 },
          }),
        ],
      }),
    });
  }

  dispose(): void {
    this.#view.destroy();
  }
}

function shadow(host: HTMLElement): ShadowRoot {
  const root = host.shadowRoot ?? host.attachShadow({ mode: "open" });
  root.replaceChildren();
  return root;
}

async function diagnostics(found: Promise<readonly TextRange[]>): Promise<Diagnostic[]> {
  return (await found).map((place) => ({ ...place }));
}
