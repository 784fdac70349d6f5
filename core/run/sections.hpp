#pragma once
// What a run remembers at some of its accepted steps, so that any part of it can be made again.

#include <cstddef>
#include <cstdint>
#include <utility>
#include <vector>

namespace invariode {

/// The start of a part of a run.
struct Section {
  std::int64_t steps;  ///< accepted before it
  double t;
  std::vector<std::byte> memory;
};

/// Sections of k steps. Whenever their memories take more than the continuous solution of one section, every other one
/// is dropped, and k doubles: for N steps both take O(√N), and N need not be known.
class Sections {
 public:
  /// Bytes of the continuous solution for each step, at most.
  explicit Sections(std::size_t bytes_of_step) : bytes_of_step_(bytes_of_step) {}

  /// Returns whether a section begins after that many steps. The first call, at the start of the run, returns true.
  [[nodiscard]] bool due(std::int64_t steps) const { return all_.empty() || steps - last_ >= every_; }
  void add(Section section) {
    last_ = section.steps;
    bytes_ += section.memory.size();
    all_.push_back(std::move(section));
    while (bytes_ > static_cast<std::size_t>(every_) * bytes_of_step_) widen();
  }
  /// Hands over the sections, once, when the run has ended.
  [[nodiscard]] std::vector<Section> take() { return std::move(all_); }

 private:
  void widen() {
    every_ *= 2;
    bytes_ = 0;
    std::size_t kept = 0;
    for (std::size_t i = 0; i < all_.size(); i += 2) {
      bytes_ += all_[i].memory.size();
      if (i != kept) all_[kept] = std::move(all_[i]);
      ++kept;
    }
    all_.resize(kept);
    last_ = all_.back().steps;
  }

  std::size_t bytes_of_step_, bytes_ = 0;
  std::int64_t every_ = 1, last_ = 0;
  std::vector<Section> all_;
};

}  // namespace invariode
