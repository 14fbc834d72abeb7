// Finds elements of index.html by their ids, and creates new elements.

/** @param {string} id */
export function element(id) {
  return document.getElementById(id);
}

/**
 * Creates an element. Attributes that are properties of the element are set as properties.
 *
 * @template {keyof HTMLElementTagNameMap} Tag
 * @param {Tag} tag
 * @param {Record<string, unknown>} attributes
 * @param {...(Node | string)} children
 * @returns {HTMLElementTagNameMap[Tag]}
 */
export function make(tag, attributes = {}, ...children) {
  const result = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name in result) Object.assign(result, { [name]: value });
    else result.setAttribute(name, String(value));
  }
  result.append(...children);
  return result;
}

/**
 * Makes the browser save bytes as a file.
 *
 * @param {string} name
 * @param {ArrayBuffer} bytes
 */
export function saveFile(name, bytes) {
  const link = make("a", { href: URL.createObjectURL(new Blob([bytes])), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}
