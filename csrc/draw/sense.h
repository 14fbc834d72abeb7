#pragma once

// The sensor pass of a frame on the CPU.

#include <atomic>
#include <vector>

#include "camera/pixel_slopes.h"
#include "draw/render.h"

namespace v3dg {

// Returns whether the sensor's channels need to know the gaussian of each record.
bool needs_source_of(const DrawnSensor& sensor);

// Runs the sensor pass over the tiles of picture.window, which is a band that was
// drawn. The planes of the sensor begin with the first pixel of the band. The workspace
// must still have the records, the sorted lists and, if needs_source_of(), the sources.
void sense_band(const std::vector<Draw<float>>& draws, const Picture<float>& picture,
                const DrawnSensor& sensor, Workspace<float>& workspace,
                const std::atomic<bool>* stop);

// Marks the pixels where the near plane clips a gaussian. A gaussian whose mean is in
// front of the near plane is not drawn. A pixel is 1 if its ray, from the near plane
// on, meets the body of such a gaussian, and otherwise 0. `draws` must have all
// gaussians that may be near, not only those in the frustum.
void mark_clipped(const std::vector<Draw<float>>& draws, const PixelSlopes& slopes,
                  const Window& window, uint8_t* clipped, const std::atomic<bool>* stop);

}  // namespace v3dg
