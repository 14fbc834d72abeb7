// Controls of the panel. Each control is added to an element, calls a function when it
// is used, and can be set to a value that was chosen elsewhere.

import { make } from "./elements.js";

/**
 * @template Value
 * @typedef {object} Control
 * @property {HTMLElement} element
 * @property {(value: Value) => void} set
 */

/**
 * @typedef {object} Range
 * @property {number} low
 * @property {number} high
 * @property {number} [step] Step of a linear slider.
 * @property {boolean} [isLogarithmic] Whether a step is a factor.
 * @property {number} value
 * @property {(value: number) => string} [text] Returns a value as text.
 * @property {string} [title]
 */

/** Step of a logarithmic slider. */
const LOGARITHMIC_STEP = 0.01;

/**
 * Adds a label and a control.
 *
 * @param {HTMLElement} parent
 * @param {string} label
 * @param {HTMLElement} control
 * @param {string} title
 * @param {Node | string} output An element between the label and the control.
 */
export function addLabelled(parent, label, control, title = "", output = "") {
  control.setAttribute("aria-label", label);
  const element = make("label", { title }, make("span", {}, label), output, control);
  parent.append(element);
  return element;
}

/**
 * Adds a slider.
 *
 * @param {HTMLElement} parent
 * @param {string} label
 * @param {Range} range
 * @param {(value: number) => void} act Called with the new value.
 * @returns {Control<number>}
 */
export function addSlider(parent, label, range, act) {
  const { low, high, value, title, text = shortText } = range;
  const { toSlider, fromSlider, step } = scaleOf(range);
  const output = make("output");
  const control = make("input", {
    type: "range",
    min: toSlider(low),
    max: toSlider(high),
    step,
  });
  const set = (/** @type {number} */ shown) => {
    control.value = String(toSlider(shown));
    output.textContent = text(shown);
  };
  set(value);
  control.addEventListener("input", () => {
    const chosen = fromSlider(Number(control.value));
    output.textContent = text(chosen);
    act(chosen);
  });
  return { element: addLabelled(parent, label, control, title, output), set };
}

/**
 * Returns the functions that convert between the value of a slider and its position.
 *
 * @param {Range} range
 */
function scaleOf({ isLogarithmic, step }) {
  if (isLogarithmic) return { toSlider: Math.log, fromSlider: Math.exp, step: LOGARITHMIC_STEP };
  return { toSlider: Number, fromSlider: Number, step };
}

/**
 * Adds a checkbox.
 *
 * @param {HTMLElement} parent
 * @param {string} label
 * @param {{ value: boolean, title: string }} state
 * @param {(value: boolean) => void} act Called with the new value.
 * @returns {Control<boolean>}
 */
export function addCheckbox(parent, label, { value, title }, act) {
  const control = make("input", { type: "checkbox", checked: value });
  control.addEventListener("change", () => act(control.checked));
  const set = (/** @type {boolean} */ isChecked) => {
    control.checked = isChecked;
  };
  return { element: addLabelled(parent, label, control, title), set };
}

/**
 * Adds a colour picker.
 *
 * @param {HTMLElement} parent
 * @param {string} label
 * @param {{ value: string, title: string }} state The colour as #rrggbb, and the title.
 * @param {(value: string) => void} act Called with the new value.
 * @returns {Control<string>}
 */
export function addColor(parent, label, { value, title }, act) {
  const control = make("input", { type: "color", value });
  control.addEventListener("input", () => act(control.value));
  const set = (/** @type {string} */ color) => {
    control.value = color;
  };
  return { element: addLabelled(parent, label, control, title), set };
}

/**
 * Adds a list of options.
 *
 * @param {HTMLElement} parent
 * @param {string} label
 * @param {{ options: string[][], value: string, title?: string }} state Pairs of key
 *   and text, the key that is chosen, and the title.
 * @param {(value: string) => void} act Called with the new key.
 * @returns {Control<string>}
 */
export function addSelect(parent, label, { options, value, title }, act) {
  const items = options.map(([key, text]) => make("option", { value: key }, text));
  const control = make("select", {}, ...items);
  control.value = value;
  control.addEventListener("change", () => act(control.value));
  const set = (/** @type {string} */ key) => {
    control.value = key;
  };
  return { element: addLabelled(parent, label, control, title), set };
}

/**
 * Adds a button.
 *
 * @param {HTMLElement} parent
 * @param {string} label
 * @param {() => void} act Called when the button is pressed.
 * @param {string} title
 */
export function addButton(parent, label, act, title = "") {
  const element = make("button", { type: "button", title }, label);
  element.addEventListener("click", act);
  parent.append(element);
  return element;
}

/**
 * Adds an element whose children are in one row.
 *
 * @param {HTMLElement} parent
 */
export function addRow(parent) {
  const element = make("div", { className: "row" });
  parent.append(element);
  return element;
}

/**
 * Adds an element for less important text.
 *
 * @param {HTMLElement} parent
 */
export function addFaintText(parent) {
  const element = make("p", { className: "faint" });
  parent.append(element);
  return element;
}

/**
 * Returns a table of texts.
 *
 * @param {(Node | string)[][]} rows The cells of each row.
 */
export function tableOf(rows) {
  const lines = rows.map((cells) => make("tr", {}, ...cells.map((cell) => make("td", {}, cell))));
  return make("table", {}, ...lines);
}

/**
 * Returns a number as text with a few digits.
 *
 * @param {number} value
 */
export function shortText(value) {
  return String(Number(value.toPrecision(3)));
}
