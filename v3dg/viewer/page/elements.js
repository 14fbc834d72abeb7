// Finds elements of index.html by their ids, and creates elements.

/**
 * Returns the element with an id.
 *
 * @param {string} id
 */
export function element(id) {
  return document.getElementById(id);
}

/**
 * Creates an element. An attribute that is a property of the element is set as a
 * property.
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
