#pragma once

// The decisions of a page pool: which pages are read, become resident, or are evicted,
// and in which order. The policy uses no threads and no files. Only one thread at a
// time may call it. That thread reports to it which pages were read.
//
// The memory of a pool has rows of gaussians and entries of clusters. It begins with
// the coarsest pages of all bundles, which are never evicted. The rest is divided into
// slots of equal size, each of which has room for any other page. A page becomes
// resident only after the page above it, and is evicted only when no page below it is
// resident. So with each resident page, all pages above it are resident.

#include <atomic>
#include <cstdint>
#include <memory>
#include <vector>

#include "base/buffer.h"
#include "residency/cluster_table.h"
#include "residency/page_source.h"

namespace v3dg {

// A bundle of which only some pages are resident. Only the constructor of PagePolicy
// reads the groups and clusters of its table.
struct PagedBundle {
    ClusterTable table;
    std::shared_ptr<const PageSource> source;
};

// The memory that a pool may use for gaussians.
struct PoolMemory {
    size_t num_bytes;
    size_t row_bytes;               // per gaussian
    size_t cluster_bytes;           // per cluster, in addition to its gaussians
    size_t most_rows = UINT32_MAX;  // maximum that the device's row indices allow

    size_t bytes_of(size_t num_rows, size_t num_clusters) const {
        return num_rows * row_bytes + num_clusters * cluster_bytes;
    }
};

// The division of the memory: first the coarsest pages, then slots of equal size.
struct SlotPlan {
    size_t first_slot_row = 0, first_slot_cluster = 0;
    size_t num_slots = 0, slot_rows = 1, slot_clusters = 1;

    size_t num_rows() const { return first_slot_row + num_slots * slot_rows; }
    size_t num_clusters() const { return first_slot_cluster + num_slots * slot_clusters; }
    // Returns the number of cluster entries that are reserved for a page of
    // `num_clusters` clusters at entry `cluster`. For a page in a slot, these are all
    // entries of the slot. A coarsest page has one entry per cluster.
    size_t num_clusters_at(size_t cluster, size_t num_clusters) const {
        return cluster < first_slot_cluster ? num_clusters : slot_clusters;
    }
    // For empty slots, returns the first row of each cluster entry. The result is
    // ascending and has num_clusters() + 1 elements.
    std::vector<int64_t> empty_offsets() const;
};

// A page that becomes resident, or that is evicted.
struct PageChange {
    uint32_t bundle, page;
    int64_t row;                 // first row of the page, or kAbsentPage if it is evicted
    size_t cluster;              // first cluster entry of the page
    const unsigned char* bytes;  // content of the page, or null if it is evicted
};

enum class PageState : uint8_t { absent, loading, loaded, resident, failed };

// A page that was read, and is not resident yet.
struct LoadedPage {
    uint32_t bundle, page;
    unsigned char* block;
    float priority = 0;  // priority in the last view that requested the page
};

// The result of PagePolicy::bring().
struct PagesComing {
    std::vector<PageChange> changes;      // in the order in which they must be applied
    std::vector<unsigned char*> dropped;  // blocks of pages that are not wanted any
                                          // more
    size_t bytes = 0;                     // total size of the pages that become resident
    // Number of pages that wait only because of the limit on bytes per frame.
    size_t num_left = 0;

    void clear();
};

// Any thread may call the const functions, except for missing() and needed(). Only the
// deciding thread may call all others.
class PagePolicy {
  public:
    // Throws std::invalid_argument if the memory has no room for the coarsest page and
    // one more page of each bundle.
    PagePolicy(const std::vector<PagedBundle>& bundles, const PoolMemory& memory);

    size_t num_slots() const { return slots_.size(); }
    const SlotPlan& plan() const { return plan_; }
    // Returns the coarsest page of a bundle. Its content is not set.
    PageChange root(size_t bundle) const;
    size_t num_pages() const { return slot_of_page_.size; }
    size_t most_page_bytes() const { return most_page_bytes_; }
    const PageSource& source(size_t bundle) const { return *bundles_[bundle].source; }
    // Returns the index of a page among the pages of all bundles.
    uint32_t id_of(size_t bundle, size_t page) const {
        return bundles_[bundle].first_page + static_cast<uint32_t>(page);
    }
    // Returns the index of the page above, or a negative number if there is none.
    int32_t page_above(uint32_t id) const { return pages_[id].parent; }

    // Returns the state of a page, which any thread may read. Reading threads change it
    // from absent to loading, and then to loaded or failed.
    std::atomic<PageState>& state(size_t bundle, size_t page) const {
        return states_[id_of(bundle, page)];
    }
    void forget_failures();
    // Allocates memory for `num_loaded` pages, so that bring() need not allocate.
    void reserve(size_t num_loaded) { left_.reserve(num_loaded); }

    // Records the pages that the cut of a frame needs, absent or resident, in any
    // order. `num_left_out` is the number of needs that did not fit in the list.
    // `has_failures` tells whether some pages cannot be read.
    void note(Span<const PageRequest> needs, size_t num_left_out, bool has_failures);
    // Sets `todo` to the absent pages of the last view. Readers take pages from the end
    // of the list, so the most urgent stretch is last. Within a stretch, pages are in
    // descending order, so that a page above is read before the pages below it. The
    // list is limited to the free memory, some of which is used by `under_way` pages
    // that are loading or loaded.
    void choose(size_t under_way, std::vector<PageRequest>& todo);
    // Return how many pages the last view misses, and how many slots it would use.
    size_t missing() const { return missing_; }
    size_t needed() const { return missing_ + num_needed_; }

    // Assigns slots to loaded pages, most urgent first: about `most_bytes` in total,
    // but at least one page. Pages that stay in `loaded` wait for a later frame, or for
    // a page above them that is still being read.
    void bring(std::vector<LoadedPage>& loaded, size_t most_bytes, PagesComing& out);

  private:
    struct Bundle {
        std::shared_ptr<const PageSource> source;
        uint32_t first_page = 0;
        size_t root_row = 0, root_cluster = 0;
        // Maxima over all pages except the coarsest ones.
        size_t most_rows = 1, most_clusters = 1, most_bytes = 1;
    };
    struct Page {
        // Index among the pages of all bundles, or -1 for a coarsest page.
        int32_t parent = -1;
        uint32_t stamp = 0;  // last view that requested the page
        float priority = 0;  // priority in that view
        // Stretch of the page in that view, if the page was wanted.
        uint32_t stretch = 0;
    };
    struct Slot {
        int32_t bundle = -1;
        uint32_t page = 0;
    };
    // When the page in a slot was last used.
    struct Use {
        uint32_t last_needed = 0;  // last view that needed the page, plus 1
        // Last view, plus 1, that needed the page or nearly needed it.
        uint32_t last_used = 0;
        // Slot of the page above; negative if that page is a coarsest page.
        int32_t above = 0;
        uint32_t num_children = 0;  // number of resident pages directly below
    };
    // How many slots have a page that was last needed (or used) in this view, and in
    // the view before.
    struct Counts {
        size_t now = 0;
        size_t before = 0;
    };
    struct Wanted {
        uint32_t bundle;
        uint32_t page;
        uint32_t key;  // urgency; see kNumKeys
    };
    // For pages of one key, their range in `todo`: the number of unused positions, and
    // the end.
    struct Places {
        uint32_t count = 0;
        uint32_t end = 0;
    };
    // A slot whose page may be evicted, unless the page was used after the slot was
    // added to the heap.
    struct Leaving {
        uint32_t last_used, slot;

        bool operator<(const Leaving& other) const {
            return last_used != other.last_used ? last_used < other.last_used : slot < other.slot;
        }
        bool operator>(const Leaving& other) const { return other < *this; }
    };

    void add_pages(Bundle& bundle, const ClusterTable& table);
    void plan_memory(const PoolMemory& memory);
    PageState state_of(size_t id) const { return states_[id].load(std::memory_order_acquire); }
    void use(int32_t slot, bool is_needed);
    size_t ask(const PageRequest& request, bool has_failures);
    int32_t block_above(int32_t id) const;
    void find_stretches();
    void touch(uint32_t& last, uint32_t value, Counts& counts);
    // Returns whether neither this view nor the previous view used the page.
    bool is_old(uint32_t last) const { return last < noted_; }
    size_t num_old(const Counts& counts) const {
        return slots_.size() - counts.now - counts.before;
    }
    bool may_go(uint32_t slot) const {
        return is_old(uses_[slot].last_needed) && uses_[slot].num_children == 0;
    }
    void find_leaving();
    bool has_leaving();
    bool make_room(bool is_missed, PagesComing& out);
    void evict(uint32_t slot, PagesComing& out);
    void occupy(const LoadedPage& loaded, PagesComing& out);

    std::vector<Bundle> bundles_;
    SlotPlan plan_;
    size_t most_page_bytes_ = 1;

    // The slot of each page. A page has none if it is absent or loading, or if it is
    // the coarsest page of its bundle.
    Buffer<int32_t> slot_storage_;
    Buffer<Page> page_storage_;
    Span<int32_t> slot_of_page_;
    Span<Page> pages_;
    std::unique_ptr<std::atomic<PageState>[]> states_;

    std::vector<Slot> slots_;
    std::vector<Use> uses_;
    std::vector<uint32_t> free_slots_;

    uint32_t noted_ = 1;  // number of recorded views, plus 1
    Counts needed_, used_;
    size_t missing_ = 0, num_needed_ = 0;
    std::vector<Wanted> wanted_;
    std::vector<uint32_t> key_of_stretch_;
    std::vector<Places> places_of_key_;
    // A heap of slots that may be evicted, with the least recently used slot in front.
    // It is kept from frame to frame: slots that become old later were also used later,
    // so the heap stays valid.
    std::vector<Leaving> leaving_;
    // True if no slot can be evicted before the next view is recorded.
    bool has_none_leaving_ = false;
    std::vector<LoadedPage> left_;
};

}  // namespace v3dg
