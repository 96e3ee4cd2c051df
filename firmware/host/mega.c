/* A simulated Arduino Mega for tests: a test turns the encoders, reads the motor's pins, and uses
 * the serial line. Time is that of the simulated processor, so a run is the same everywhere. */
#include <stdint.h>
#include <string.h>

#include <simavr/avr_ioport.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>

#define CYCLES_PER_US 16
#define US_PER_BYTE 87 /* ten bits at 115200 baud */
#define US_PER_EDGE 20 /* between two edges of an encoder: 50,000 counts a second */

/* The registers behind the motor's pins: 6 is channel A of timer 4, 7 is bit 4 of port H. */
#define TCCR4A 0xA0
#define COM4A1 0x80
#define OCR4AL 0xA8
#define OCR4AH 0xA9
#define PORTH 0x102

/* Channels A and B of each encoder: pins 2 and 3, 18 and 19, 20 and 21. */
static const struct {
    char port;
    int pin;
} CHANNELS[3][2] = {{{'E', 4}, {'E', 5}}, {{'D', 3}, {'D', 2}}, {{'D', 1}, {'D', 0}}};

static avr_t *avr;
static int phase[3] = {2, 2, 2}; /* steps turned; both channels begin high, as pulled up */
static uint8_t to_board[1 << 16], from_board[1 << 16];
static uint16_t sent, arrived, said, heard; /* they overflow, as indices of ring buffers */

static void hear(struct avr_irq_t *irq, uint32_t byte, void *unused)
{
    (void)irq;
    (void)unused;
    from_board[said++] = (uint8_t)byte;
}

static void set_channels(int encoder)
{
    static const int A[] = {0, 1, 1, 0}, B[] = {0, 0, 1, 1};
    const int step = phase[encoder] & 3;
    const int levels[] = {A[step], B[step]};
    for (int i = 0; i < 2; ++i)
        avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ(CHANNELS[encoder][i].port),
                                    CHANNELS[encoder][i].pin),
                      (uint32_t)levels[i]);
}

/* Load a program; 0: it was loaded. */
int mega_power_on(const char *elf)
{
    elf_firmware_t program;
    memset(&program, 0, sizeof program);
    if (elf_read_firmware(elf, &program) != 0)
        return 1;
    strcpy(program.mmcu, "atmega2560");
    program.frequency = 16000000;
    avr = avr_make_mcu_by_name(program.mmcu);
    if (!avr || avr_init(avr) != 0)
        return 1;
    avr_load_firmware(avr, &program);
    uint32_t flags = 0; /* do not print what it sends, do not sleep while it waits */
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), hear,
                            NULL);
    for (int i = 0; i < 3; ++i)
        set_channels(i);
    return 0;
}

/* Let this time pass on the board; 0: it still runs. */
int mega_run(uint32_t us)
{
    static avr_cycle_count_t next_byte;
    const avr_cycle_count_t until = avr->cycle + (avr_cycle_count_t)us * CYCLES_PER_US;
    while (avr->cycle < until) {
        if (arrived != sent && avr->cycle >= next_byte) {
            avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT),
                          to_board[arrived++]);
            next_byte = avr->cycle + US_PER_BYTE * CYCLES_PER_US;
        }
        const int state = avr_run(avr);
        if (state == cpu_Done || state == cpu_Crashed)
            return 1;
    }
    return 0;
}

/* Turn an encoder by this number of counts, edge by edge; 0: the board still runs. */
int mega_turn(int encoder, int32_t counts)
{
    const int step = counts < 0 ? -1 : 1;
    for (; counts; counts -= step) {
        phase[encoder] += step;
        set_channels(encoder);
        if (mega_run(US_PER_EDGE) != 0)
            return 1;
    }
    return 0;
}

/* Make one channel of an encoder flicker, an edge every few microseconds, like a broken wire. */
int mega_flicker(int encoder, uint32_t us, uint32_t us_per_edge)
{
    for (uint32_t at = 0; at < us; at += us_per_edge) {
        phase[encoder] ^= 1;
        set_channels(encoder);
        if (mega_run(us_per_edge) != 0)
            return 1;
    }
    return 0;
}

/* Microseconds since power-on. */
uint64_t mega_clock(void) { return avr->cycle / CYCLES_PER_US; }

/* Have a byte go to the board as the line carries it. */
void mega_send(uint8_t byte) { to_board[sent++] = byte; }

/* The next byte that came from it; -1: none. */
int mega_receive(void) { return heard == said ? -1 : from_board[heard++]; }

/* What the motor's pins say, duty counts. */
int mega_duty(void)
{
    const uint8_t *registers = avr->data;
    if (!(registers[TCCR4A] & COM4A1))
        return 0;
    const int size = (registers[OCR4AH] << 8 | registers[OCR4AL]) + 1;
    return registers[PORTH] & 0x10 ? -size : size;
}
