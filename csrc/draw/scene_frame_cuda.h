#pragma once

// Frames of a scene on a CUDA device: a request in, an enqueued drawing out; and the models that
// they draw.

#include "draw/device_pages.h"
#include "draw/frame_cuda.h"
#include "draw/request.h"
#include "quantize/quantize.h"
#include "select/select_cuda.h"

namespace v3dg {
namespace cuda {

// The only picture of a frame; `first_tile` and the tiles are filled in.
FrameImage frame_image(const Intrinsics<float>& camera, int width, int height,
                       const float background[3], const PicturePlanes& planes);

// Gaussians that stay as they are, and packed.
class PackedModel {
  public:
    PackedModel(const GaussianRows<const float>& rows, cudaStream_t stream);
    const GaussianRows<const float>& rows() const { return rows_; }
    const PackedPlanes& packed() const { return packed_; }
    size_t bytes() const { return planes_.capacity() * sizeof(float); }

  private:
    GaussianRows<const float> rows_;
    DeviceBuffer<float> planes_;
    PackedPlanes packed_;
};

// Gaussians as codes on the device that is current when they are made: all records, then all
// coefficients, so that a row's place follows from its number.
class CodedModel {
  public:
    // Returns when they are there.
    CodedModel(const CodedPages& pages, cudaStream_t stream);
    const Codes& codes() const { return codes_; }
    size_t bytes() const {
        return records_.bytes() + sh_.bytes() + ranges_.bytes() + offset_.bytes();
    }

  private:
    DeviceBuffer<uint32_t> records_, sh_;
    DeviceBuffer<unsigned char> ranges_;
    DeviceBuffer<int64_t> offset_;
    Codes codes_;
};

// The gaussians of a bundle: one of the two.
struct DeviceModel {
    std::shared_ptr<const PackedModel> packed;
    std::shared_ptr<const CodedModel> coded;
};

// Colours of the clusters of one bundle.
class DevicePalette {
  public:
    // `sh` is (C, 3), coefficients of the constant basis; the host's memory may be reused on
    // return.
    DevicePalette(Span<const float> sh, std::shared_ptr<const BundleTables> tables,
                  cudaStream_t stream);
    Palette palette() const;

  private:
    std::shared_ptr<const BundleTables> tables_;
    DeviceBuffer<float> sh_;
};

// The pictures of two eyes in one frame.
EyeImages images_of_eyes(const FrameImage& left, FrameImage right, float min_transmittance);

// Draws a scene that stays on the device: selects, then draws the cut.
class SceneFrame {
  public:
    // The gaussians of each bundle of the scenes that are drawn next and, unless there are none,
    // the colours of their clusters. The host's arrays may be reused on return.
    void set_models(std::vector<DeviceModel> models,
                    std::vector<std::shared_ptr<const DevicePalette>> palettes,
                    cudaStream_t stream);

    // Draws what is asked for, plainly (FrameRequest::is_plain), into `pictures`; `place` says
    // where they are. With `pages`, what is resident of the bundles of a pool, with what comes in
    // before. `rule` is the one of the request, as the pacing of a budget has changed it, and
    // becomes the one that is used. What is drawn stays until the drawing is finished: the scene,
    // the pool, and a given cut, which is on the device and has one picture. A frame that is drawn
    // again has the pages that are there by then.
    std::unique_ptr<Drawing> draw(const SceneTables& scene, DevicePages* pages,
                                  const FrameRequest& request, SelectRule& rule,
                                  const EyeImages& pictures, cudaStream_t stream,
                                  const Frame::Place& place);

    // Bytes of what it keeps on the device, by part, without the models.
    std::vector<std::pair<const char*, size_t>> bytes() const;

  private:
    std::unique_ptr<Drawing> draw_selected(const SceneTables& scene, const Eyes& eyes,
                                           const SelectRule& rule, const EyeImages& pictures,
                                           cudaStream_t stream, const Frame::Place& place);
    std::unique_ptr<Drawing> draw_resident(const SceneTables& scene, DevicePages& pages,
                                           const Eyes& eyes, SelectRule& rule,
                                           const EyeImages& pictures, cudaStream_t stream,
                                           const Frame::Place& place);
    std::unique_ptr<Drawing> draw_given(const SceneTables& scene, const Camera& camera,
                                        const GivenCut& given, const EyeImages& pictures,
                                        cudaStream_t stream, const Frame::Place& place);
    // Of the models that were set.
    FrameBatch batch(const SceneTables& scene, const EyeImages& pictures, const SelectRule& rule,
                     cudaStream_t stream);

    std::vector<DeviceModel> models_;
    std::vector<std::shared_ptr<const DevicePalette>> palettes_;
    DeviceBuffer<GaussianRows<const float>> rows_;
    DeviceBuffer<PackedPlanes> packed_;
    DeviceBuffer<CodedGaussians> coded_;
    bool has_packed_ = false, has_coded_ = false;
    DeviceBuffer<Placement> placements_;
    DeviceBuffer<FrameImage> images_;
    Cut cut_;
    Frame frame_;
};

// One model in front of one camera.
struct ModelTables {
    GaussianRows<const float> rows;
    PackedPlanes packed;
    Placement placement;
    FrameImage image;
};

// Draws all gaussians of one model.
class ModelFrame {
  public:
    explicit ModelFrame(Frame::Keeps keeps = Frame::Keeps::nothing) : frame_(keeps) {}

    // The rows, and what is packed of them, stay where they are until the drawing is finished.
    std::unique_ptr<Drawing> draw(const GaussianRows<const float>& rows,
                                  const ModelView<float>& view, float filter_px2, bool antialiased,
                                  const FrameImage& image, cudaStream_t stream,
                                  const PackedPlanes* packed = nullptr,
                                  float min_transmittance = kStopsBefore,
                                  const Frame::Place& place = {});
    FrameTape tape() const { return frame_.tape(); }

  private:
    DeviceBuffer<ModelTables> tables_;
    Frame frame_;
};

}  // namespace cuda
}  // namespace v3dg
