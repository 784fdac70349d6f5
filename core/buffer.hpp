#pragma once
// A growing array for output. Large blocks grow where they are, or by moving pages, and consist of large pages where
// the system has them: a std::vector would copy them, and touch new memory each time, which costs as much as the steps
// that fill it.

#include <cassert>
#include <cstddef>
#include <cstdlib>
#include <cstring>
#include <type_traits>
#include <utility>
#include <vector>

namespace invariode {

/// The block with room for so many bytes, perhaps elsewhere.
[[nodiscard]] void* resized_block(void* block, std::size_t bytes);

template <class T>
class Buffer {
  static_assert(std::is_trivially_copyable_v<T>);

 public:
  Buffer() = default;
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;
  Buffer(Buffer&& other) noexcept { swap(other); }
  Buffer& operator=(Buffer&& other) noexcept {
    swap(other);
    return *this;
  }
  ~Buffer() { std::free(data_); }

  void push_back(const T& value) {
    if (size_ == capacity_) {
      const T copy = value;  // which may be one of ours
      grow(size_ + 1);
      data_[size_++] = copy;
    } else {
      data_[size_++] = value;
    }
  }
  void append(const T* values, std::size_t count) {
    if (count == 0) return;
    if (size_ + count > capacity_) grow(size_ + count);
    std::memcpy(data_ + size_, values, count * sizeof(T));
    size_ += count;
  }
  /// Room for so many values behind the last, which `fill_room` makes part of the array once they have been written.
  [[nodiscard]] T* room(std::size_t count) {
    if (size_ + count > capacity_) grow(size_ + count);
    return data_ + size_;
  }
  void fill_room(std::size_t count) {
    assert(size_ + count <= capacity_);
    size_ += count;
  }
  void reserve(std::size_t capacity) {
    if (capacity > capacity_) resize_block(capacity);
  }
  void clear() { size_ = 0; }

  [[nodiscard]] std::size_t size() const { return size_; }
  [[nodiscard]] bool empty() const { return size_ == 0; }
  [[nodiscard]] T* data() { return data_; }
  [[nodiscard]] const T* data() const { return data_; }
  [[nodiscard]] const T* begin() const { return data_; }
  [[nodiscard]] const T* end() const { return data_ + size_; }
  [[nodiscard]] const T& front() const {
    assert(size_ > 0);
    return data_[0];
  }
  [[nodiscard]] const T& back() const {
    assert(size_ > 0);
    return data_[size_ - 1];
  }
  [[nodiscard]] const T& operator[](std::size_t i) const {
    assert(i < size_);
    return data_[i];
  }

  [[nodiscard]] std::vector<T> copy() const { return {begin(), end()}; }

  /// Gives the values away, in a block of their size (if there are any) that is to be returned with std::free.
  [[nodiscard]] T* release() {
    if (size_ < capacity_ && size_ > 0) resize_block(size_);
    size_ = capacity_ = 0;
    return std::exchange(data_, nullptr);
  }

 private:
  void grow(std::size_t least) {
    constexpr std::size_t smallest = 64;
    std::size_t capacity = capacity_ < smallest ? smallest : 2 * capacity_;
    resize_block(capacity < least ? least : capacity);
  }
  void resize_block(std::size_t capacity) {
    data_ = static_cast<T*>(resized_block(data_, capacity * sizeof(T)));
    capacity_ = capacity;
  }
  void swap(Buffer& other) noexcept {
    std::swap(data_, other.data_);
    std::swap(size_, other.size_);
    std::swap(capacity_, other.capacity_);
  }

  T* data_ = nullptr;
  std::size_t size_ = 0, capacity_ = 0;
};

}  // namespace invariode
