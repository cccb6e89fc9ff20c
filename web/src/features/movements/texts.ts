import type { FieldKind, FieldError } from "./model/parameter-form";
import { format } from "../../shared/i18n/format";

export const texts = {
  library: {
    title: "Movements",
    explain: "Scripts that a robot runs on its own: built-in ones and your own. Open one to view, edit or run it.",
    search: "Search",
    searchExample: "Name, description or robot type",
    noMatches: "No movements match your search.",
    count: (count: number): string => format.count(count, "movement"),
    builtIn: "built-in",
    own: "own",
    shipped: (version: number): string => `Version ${version}, part of the robot type`,
    saved: (version: number, at: string): string => `Version ${version}, saved by you on ${format.dateTime(at)}`,
    remove: "Delete",
    removeOf: (name: string): string => `Delete ${name}`,
    removeSure: (name: string): string => `Delete ${name} with all versions?`,
    removeYes: "Delete",
    removing: "Deleting…",
    removed: (name: string): string => `${name} was deleted. A built-in movement with the same name is used again.`,
    keep: "Cancel",
    create: "New movement",
    robotType: "Robot type",
    name: "Name",
    nameExample: "bow_twice",
    beginKeyframes: "Create with keyframes",
    submit: "Create script",
    badName: "Use unaccented letters, digits, _ and -, without spaces; at most 64 characters.",
    nameExists: "This robot type already has a movement with this name.",
    /** The script of a new movement. */
    template: `"""Describe the movement in one line."""

PARAMETERS = {
    "speed": {
        "type": "number",
        "minimum": 0.05,
        "maximum": 1,
        "default": 0.3,
        "description": "Share of the joints' velocity limits",
    },
}

robot.home(speed=parameters["speed"])
print("done")
`,
  },

  editor: {
    title: "Script",
    label: (name: string): string => `Script of ${name}, in Python`,
    keys: "Ctrl+Space shows completions. Tab moves to the next control. Escape leaves the editor, or stops the selected robots.",
    save: "Save",
    saving: "Saving…",
    asKeyframes: "Edit as keyframes",
    unsaved: "New: not saved",
    changed: (version: number): string => `Changed since version ${version}`,
    isSaved: (version: number, builtIn: boolean): string => (builtIn ? `Version ${version}, built-in` : `Saved as version ${version}`),
    failed: (reason: string): string => `The movement failed to load: ${reason}`,
    refused: (reason: string): string => `Not saved. ${reason} Your text is kept in this browser.`,
    restored: (age: string): string => `Unsaved draft from ${age} restored.`,
    discard: "Discard draft",
    discarded: "Draft discarded. Showing the saved text.",
    undo: "Undo",
    deleted: "Not saved: the movement was deleted in the meantime. Your text is still here.",
    conflict: (version: number, at: string): string =>
      `Not saved: version ${version} was saved in the meantime, on ${format.dateTime(at)}. Below is your text with the differences.`,
    bothLabel: (version: number): string => `Your text, compared with version ${version}`,
    saveMine: "Save mine as the newest version",
    takeTheirs: (version: number): string => `Continue with version ${version}`,
    checkError: (reason: string): string => `The script check failed: ${reason}`,
    problems: "Problems",
    count: (errors: number, all: number): string => {
      if (all === 0) return "No problems found.";
      const warnings = all - errors;
      const parts = [
        ...(errors > 0 ? [format.count(errors, "error")] : []),
        ...(warnings > 0 ? [format.count(warnings, "warning")] : []),
      ];
      return `${parts.join(", ")}:`;
    },
    line: (line: number): string => `Line ${line}`,
  },

  versions: {
    title: "Versions",
    one: (version: number): string => `Version ${version}`,
    view: "View",
    viewVersion: (version: number): string => `View version ${version}`,
    close: "Close",
    closeOf: (version: number): string => `Close version ${version}`,
    same: (version: number): string => `Version ${version} is identical to the text in the editor.`,
    explain: (version: number): string => `The text in the editor, with changes since version ${version}:`,
    label: (version: number): string => `The text in the editor, compared with version ${version}`,
    restore: (version: number): string => `Restore version ${version}`,
  },

  parameters: {
    title: "Parameters",
    of: (name: string): string => `Parameters of ${name}`,
    none: "No parameters.",
    withDefaults: "Runs with the default parameters",
    reset: "Reset to defaults",
    optional: "(optional)",
    choose: "Choose…",
    fixErrors: "Correct the errors above first.",
    range: (least: number | null, most: number | null, unit: string): string => {
      const of = (value: number): string => `${value}${unit.startsWith("°") || unit === "" ? unit : ` ${unit}`}`;
      if (least !== null && most !== null) return `${of(least)} to ${of(most)}`;
      if (least !== null) return `at least ${of(least)}`;
      return most === null ? "" : `at most ${of(most)}`;
    },
    hints: {
      number: "",
      integer: "an integer",
      text: "",
      choice: "",
      "yes-no": "",
      list: "numbers, separated by spaces",
      json: "as JSON",
    } satisfies Record<FieldKind, string>,
    error: (wrong: FieldError, unit: string): string => {
      const limit = "limit" in wrong ? `${wrong.limit} ${unit}`.trim() : "";
      switch (wrong.kind) {
        case "missing":
          return "This field is required.";
        case "number":
          return "Enter a number.";
        case "whole":
          return "Enter an integer.";
        case "json":
          return "Enter valid JSON.";
        case "least":
          return `At least ${limit}.`;
        case "most":
          return `At most ${limit}.`;
        case "above":
          return `More than ${limit}.`;
        case "below":
          return `Less than ${limit}.`;
        case "shorter":
          return `At least ${wrong.limit} characters.`;
        case "longer":
          return `At most ${wrong.limit} characters.`;
        case "fewer":
          return `At least ${wrong.limit} values.`;
        case "more":
          return `At most ${wrong.limit} values.`;
      }
    },
  },

  many: {
    title: "Run",
    bar: "Selected robots",
    robots: "Robots",
    none: "You have no robots of this type.",
    others: (labels: readonly string[]): string =>
      `Not available for ${labels.join(", ")}: a shared robot runs its owner's movements, on its own page.`,
    chooseAll: "Select all",
    chosen: (count: number): string => `${format.count(count, "robot")} selected`,
    running: (count: number, all: number): string => (all === 1 ? "Running" : `Running on ${count} of ${all} robots`),
    run: (count: number): string => (count < 2 ? "Run" : `Run on ${count} robots`),
    saveAndRun: (count: number): string => (count < 2 ? "Save and run" : `Save and run on ${count} robots`),
    starting: "Starting…",
    rows: "Results",
    cancelAll: "Cancel all",
    stop: "Stop",
    stopAll: "Stop all",
    stopKey: "Esc",
    stopKeyExplained: "The Escape key stops the selected robots, regardless of the keyboard focus.",
    cancelOf: (label: string): string => `Cancel on ${label}`,
    stopOf: (label: string): string => `Stop ${label}`,
    outputOf: (label: string): string => `Output on ${label}`,
    noAnswer: "The server returned no result for this robot.",
  },

  movements: {
    title: "Movements",
    run: "Run",
    runNamed: (name: string): string => `Run ${name}`,
    cancel: "Cancel",
    none: "This robot type has no movements.",
    failed: (reason: string): string => `The movements failed to load: ${reason}`,
    retry: "Try again",
    own: "own",
    output: "Output",
    viewer: "You are a viewer of this device. Ask its owner for operator access.",
  },
};
