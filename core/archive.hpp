#pragma once
// What a run remembers between two steps, as bytes: it goes on from them as if it had never been interrupted.

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <span>
#include <stdexcept>
#include <type_traits>
#include <utility>
#include <vector>

#include "buffer.hpp"

namespace invariode {

using Memory = Buffer<std::byte>;

/// Bytes to which a memory is written, or from which it is read. Each class has one function `state(Archive&)` that
/// names its fields, so that what is written and what is read cannot disagree. Sizes are those of the problem: what
/// reads has been made for the same one, and a field of another size throws std::invalid_argument.
class Archive {
 public:
  /// Raised whenever the fields of any class change, or their order.
  static constexpr std::uint32_t version = 4;

  /// To write. Where it would take more than `most_values` matrix entries, matrices are left out: whoever reads it
  /// starts the method anew.
  explicit Archive(std::size_t most_values) : most_values_(most_values) {
    std::uint32_t own = version;
    (*this)(own, whole_);
  }
  /// To read bytes that belong to the caller and outlive this.
  explicit Archive(std::span<const std::byte> bytes) : reading_(true), source_(bytes) {
    std::uint32_t written = 0;
    (*this)(written, whole_);
    if (written != version) throw std::invalid_argument("the memory of the run is of another version");
  }

  [[nodiscard]] bool reading() const { return reading_; }
  /// Whether the matrices are there.
  [[nodiscard]] bool whole() const { return whole_; }
  /// A user function has stopped the reading: see `Status::stop`.
  void stop() { stopped_ = true; }
  [[nodiscard]] bool stopped() const { return stopped_; }
  /// What was read must be so.
  void require(bool right) const {
    if (!right) throw damaged();
  }
  /// All has been read.
  [[nodiscard]] bool exhausted() const { return place_ == source_.size(); }

  /// What was written, once.
  [[nodiscard]] Memory take() {
    std::memcpy(written_.data() + sizeof(version), &whole_, sizeof(whole_));
    return std::move(written_);
  }

  /// Fields one after the other: numbers, enumerations, and vectors of these that keep their size.
  template <class... Fields>
  void operator()(Fields&... fields) {
    (field(fields), ...);
  }
  /// `count` numbers.
  template <class T>
  void values(T* first, std::size_t count) {
    static_assert(std::is_trivially_copyable_v<T>);
    bytes(first, count * sizeof(T));
  }
  /// A vector that takes the size of what was written.
  template <class T>
  void resizable(std::vector<T>& v) {
    std::uint64_t size = v.size();
    field(size);
    if (reading_) {
      if (size > (source_.size() - place_) / sizeof(T)) throw damaged();
      v.resize(size);
    }
    values(v.data(), v.size());
  }
  /// The entries of a matrix. False: they are left out.
  bool matrix(std::vector<double>& entries) {
    bool kept = entries.size() <= most_values_;
    field(kept);
    whole_ = whole_ && kept;
    if (kept) resizable(entries);
    return kept;
  }

 private:
  static std::invalid_argument damaged() {
    return std::invalid_argument("the memory of the run is damaged, or of another problem");
  }

  template <class T>
  void field(T& value) {
    static_assert(std::is_arithmetic_v<T> || std::is_enum_v<T>);
    bytes(&value, sizeof(T));
  }
  template <class T>
  void field(std::vector<T>& v) {
    std::uint64_t size = v.size();
    field(size);
    if (size != v.size()) throw damaged();
    values(v.data(), v.size());
  }

  void bytes(void* data, std::size_t size) {
    if (size == 0) return;
    if (reading_) {
      if (size > source_.size() - place_) throw damaged();
      std::memcpy(data, source_.data() + place_, size);
      place_ += size;
    } else {
      written_.append(static_cast<const std::byte*>(data), size);
    }
  }

  bool reading_ = false;
  bool whole_ = true;
  bool stopped_ = false;
  std::size_t most_values_ = 0;
  Memory written_;
  std::span<const std::byte> source_;
  std::size_t place_ = 0;
};

}  // namespace invariode
