"""Tables of 256 numbers by Lloyd's algorithm, palettes of vectors, and the order along
a Morton curve."""

import numpy as np

SIZE = 256
BINS, ROUNDS, EVEN = 4096, 16, 0.25


def codebook_of(values):
    """Return 256 ascending numbers that approximate the values (N,)."""
    distinct = np.unique(values)
    if len(distinct) <= SIZE:
        return (
            np.pad(distinct, (0, SIZE - len(distinct)), "edge") if len(distinct) else np.zeros(SIZE)
        )
    counts, edges = np.histogram(values, BINS)
    density = np.cbrt(counts)
    share = np.cumsum([0.0, *((1 - EVEN) * density / density.sum() + EVEN / BINS)])
    table = np.interp((np.arange(SIZE) + 0.5) / SIZE, share, edges)
    for _ in range(ROUNDS):
        near = np.searchsorted((table[1:] + table[:-1]) / 2, values)
        means = [values[near == k].mean() if (near == k).any() else table[k] for k in range(SIZE)]
        table = np.sort(means)
    return table


def palette_of(vectors, size):
    """Return vectors (K, D) that approximate the vectors (N, D), and the index (N,) of
    the best vector for each."""
    vectors = vectors.astype(np.float64)
    parts = [np.arange(len(vectors))] if len(vectors) else []
    while parts and len(parts) < size:
        errors = [np.square(vectors[rows] - vectors[rows].mean(axis=0)) for rows in parts]
        worst = int(np.argmax([error.sum() for error in errors]))
        if errors[worst].sum() == 0:
            break
        rows = parts.pop(worst)
        column = vectors[rows, errors[worst].sum(axis=0).argmax()]
        above = column > column.mean()
        parts += [rows[~above], rows[above]]
    parts.sort(key=lambda rows: rows[0])
    labels = np.zeros(len(vectors), np.uint32)
    for entry, rows in enumerate(parts):
        labels[rows] = entry
    palette = [vectors[rows].mean(axis=0) for rows in parts]
    return np.array(palette or np.zeros((1, vectors.shape[1]))), labels


def morton_order(means):
    """Return indices that sort points (N, 3) by the interleaved bits of their cells,
    2^21 per side."""
    if not len(means):
        return np.zeros(0, np.int64)
    low = means.min(axis=0).astype(np.float64)
    extent = np.maximum(means.max(axis=0) - low, np.finfo(np.float32).tiny)
    cells = ((means - low) / extent * (2**21 - 1)).astype(np.int64)
    codes = [sum((int(c[b % 3]) >> b // 3 & 1) << b for b in range(63)) for c in cells]
    return np.array(sorted(range(len(codes)), key=codes.__getitem__))
